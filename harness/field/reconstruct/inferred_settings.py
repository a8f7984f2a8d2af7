"""Which settings agents had that left no trace: those with which the protocol explains what they sent.

Some show in messages: a vote that names a chain, and how full blocks are. Of the others each is tried by itself.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from harness.checker.steps.trace_header import CheckedHeader
from harness.field.reconstruct.inferring import infer
from harness.field.reconstruct.other_records import Captured, Elsewhere
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import BlockAddResponse, decode
from ucp.settings import Settings

TRIES = 10
"""Orders of what one agent received that are tried with one reading."""


def likely(
    elsewhere: Elsewhere, captured: dict[int, Captured], header_of: Callable[[int, Settings], CheckedHeader]
) -> Settings:
    """The settings that explain the most of what the captured agents sent."""
    events = {agent_id: elsewhere.events(agent_id) for agent_id in captured}

    def explained(settings: Settings) -> tuple[int, int]:
        """How many agents, and how many of their inputs."""
        inferred = [
            infer(header_of(agent_id, settings), seen, events[agent_id], tries=TRIES)
            for agent_id, seen in captured.items()
        ]
        return sum(one.problem is None for one in inferred), sum(one.explained for one in inferred)

    seen = _seen(elsewhere)
    best, most = seen, explained(seen)
    for settings in _others(seen):
        if most[0] == len(captured):
            break
        if (more := explained(settings)) > most:
            best, most = settings, more
    return best


def _others(seen: Settings) -> Iterator[Settings]:
    yield replace(seen, phase2_tie="block")
    yield replace(seen, phase1_tie="pop")
    yield replace(seen, changed_before_tally=True)
    yield replace(seen, finalize_gap_s=0.0)


def _seen(elsewhere: Elsewhere) -> Settings:
    """What messages and blocks show."""
    votes = (decode(datagram).message for datagram in elsewhere.all_datagrams())
    names_chain = any(isinstance(vote, BlockAddResponse) and vote.chain_hash is not None for vote in votes)
    usual = Settings()
    return replace(
        usual,
        vote_names_chain=names_chain,
        max_block_bytes=_fullness(elsewhere.event_data(), usual.max_event_bytes),
    )


def _fullness(blocks: Iterable[bytes], largest: int) -> int:
    """max_block_bytes: a block is full as soon as another event of the largest size might not fit."""
    least, most = largest, MAX_EVENT_DATA_BYTES
    for event_data in blocks:
        last = _last_event_bytes(event_data)
        if last is not None:
            least = max(least, len(event_data) - last + largest + 1)
            most = min(most, len(event_data) + largest)
    usual = Settings().max_block_bytes
    return usual if least <= usual <= most or least > most else most


def _last_event_bytes(event_data: bytes) -> int | None:
    try:
        events = decode_events(event_data)
    except MalformedEventsError:
        return None
    return events[-1].encoded_bytes if events else None
