"""Test vectors for full blocks: a sequence of logged events, and the blocks that they complete."""

from collections.abc import Iterable
from typing import Any

from ucp.agent import Agent
from ucp.events import EVENT_HEADER_BYTES, LoggableEvent
from ucp.settings import Settings
from ucp.trace import HandlerRun

AGENT_ID = 7


def _events(sizes: Iterable[int], timestamps_us: Iterable[int]) -> list[LoggableEvent]:
    """Return events with these sizes in bytes, including the header of each event."""
    return [
        LoggableEvent(timestamp_us, 1 + number % 254, bytes([number % 256]) * (size - EVENT_HEADER_BYTES))
        for number, (size, timestamp_us) in enumerate(zip(sizes, timestamps_us, strict=True))
    ]


CASES: tuple[tuple[str, Settings, list[LoggableEvent]], ...] = (
    ("the largest events", Settings(), _events([267] * 8, range(1_000_000, 9_000_000, 1_000_000))),
    ("756 bytes are not full, 757 are", Settings(), _events([256, 256, 244, 11], (10, 20, 30, 40))),
    ("757 bytes at once", Settings(), _events([256, 256, 245, 256, 256, 245], (10, 20, 30, 40, 50, 60))),
    (
        "every event is a block",
        Settings(max_block_bytes=267),
        _events([11, 267, 43], (10, 20, 30)),
    ),
    (
        "a clock that stands still, and goes back",
        Settings(max_block_bytes=267),
        _events([20, 20, 20, 20, 20], (500, 500, 500, 400, 900)),
    ),
    (
        "small blocks of small events",
        Settings(max_block_bytes=64, max_event_bytes=20),
        _events([11, 11, 11, 11, 20, 20, 12, 11, 11, 11], range(100, 1100, 100)),
    ),
    ("the last event's timestamp, not the newest", Settings(max_block_bytes=300), _events([20, 20], (900, 700))),
)


def vectors() -> list[dict[str, Any]]:
    """Return the test vectors. For each event, a vector contains the branch that Algorithm 1 takes, and the block that
    the event completes. If the event completes no block, the vector contains null.
    """
    return [
        {
            "what": what,
            "agent_id": AGENT_ID,
            "max_block_bytes": settings.max_block_bytes,
            "max_event_bytes": settings.max_event_bytes,
            "events": _logged(settings, events),
        }
        for what, settings, events in CASES
    ]


def _logged(settings: Settings, events: list[LoggableEvent]) -> list[dict[str, Any]]:
    agent = Agent(AGENT_ID, [AGENT_ID], b"", settings)
    logged = []
    for event in events:
        agent.add_event(event, 0.0)
        run = next(entry for entry in agent.trace() if isinstance(entry, HandlerRun))
        entry: dict[str, Any] = {
            "timestamp_us": event.timestamp_us,
            "event_id": event.event_id,
            "data": event.data,
            "branch": run.branch,
        }
        if run.branch == "full":
            block = agent.state.blocks_to_be_committed[-1]
            entry["block"] = {"block_data": block.block_data(), "block_hash": block.block_hash.hex()}
        logged.append(entry)
    return logged
