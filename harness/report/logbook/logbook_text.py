"""Write the logbook as text for readers, and as JSON for programs."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

from harness.archive.exports import Export, ExportedBlock
from harness.present.text import moment
from harness.report.logbook import Logbook, SealedError
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.telemetry import describe, vehicle_type

_HASH_DIGITS = 12
_BYTES_SHOWN = 8


def lines(logbook: Logbook, decode: bool) -> Iterator[str]:
    """Yield the lines of each agent's chain, with the oldest block first. If `decode` is true, the lines describe the
    events in words.
    """
    vehicle_types = _vehicle_types(logbook) if decode else {}
    for agent_id, export in logbook.exports.items():
        yield f"agent {agent_id}: a chain of {_count(len(export.chain), 'block')}, top {_short(export.top_chain_hash)}"
        names = [logbook.name(block.block_hash) for block in export.chain]
        width = max(map(len, names), default=0)
        for name, block in zip(names, export.chain, strict=True):
            yield f"  {name:<{width}}  {_block(block, logbook)}"
            if decode:
                yield from (f"    {line}" for line in _events(block, logbook, vehicle_types))
        if outside := _outside_chain(export):
            yield f"  beside the chain: {outside}"


def document(logbook: Logbook, decode: bool) -> dict[str, object]:
    """Return the logbook as a JSON object. Data and hashes are hexadecimal, and times are in microseconds.

    `events` is null for a block whose events are unreadable or encrypted.
    """
    vehicle_types = _vehicle_types(logbook) if decode else {}
    return {
        "source": "mavlink" if logbook.telemetry else "random or scripted",
        "agents": {
            str(agent_id): {
                "top_chain_hash": export.top_chain_hash,
                "chain": [_block_document(logbook, block, decode, vehicle_types) for block in export.chain],
            }
            for agent_id, export in logbook.exports.items()
        },
        "errors": [*logbook.absent.values(), *logbook.errors],
    }


def words(event: LoggableEvent, telemetry: bool, of_type: int | None = None) -> str:
    """Return a description of an event. `of_type` is the MAV_TYPE of the vehicle whose agent logged the event."""
    description = describe(event.event_id, event.data, of_type) if telemetry else ""
    if description and description != "unreadable":
        return description
    shown = event.data[:_BYTES_SHOWN].hex() + ("…" if len(event.data) > _BYTES_SHOWN else "")
    raw = f"event {event.event_id}, {_count(len(event.data), 'byte')}" + (f": {shown}" if shown else "")
    return f"{description}: {raw}" if description else raw


def _vehicle_types(logbook: Logbook) -> dict[int, int]:
    """Return the MAV_TYPE of each agent's vehicle. The first event about a flight mode that the agent logged contains
    the MAV_TYPE.
    """
    types: dict[int, int] = {}
    if not logbook.telemetry:
        return types
    blocks = {block.block_hash: block for export in logbook.exports.values() for block in export.chain}
    for block in blocks.values():
        with contextlib.suppress(MalformedEventsError):
            for event in logbook.event_data.events(block) if block.agent_id not in types else ():
                if (kind := vehicle_type(event.event_id, event.data)) is not None:
                    types.setdefault(block.agent_id, kind)
    return types


def _time(timestamp_us: int, logbook: Logbook) -> str:
    """Format a timestamp as text. The text begins with the mission second, unless the mission second and the timestamp
    are the same number.
    """
    mission_s = logbook.mission_s(timestamp_us) if logbook.epoch_us else None
    return moment(timestamp_us) if mission_s is None else f"{mission_s:8.1f} s  {moment(timestamp_us)}"


def _block(block: ExportedBlock, logbook: Logbook) -> str:
    try:
        events = _count(len(logbook.event_data.events(block)), "event")
    except SealedError as sealed:
        events = str(sealed)
    except MalformedEventsError:
        events = "unreadable events"
    return f"{_time(block.timestamp_us, logbook)}  {_short(block.block_hash)}  {events}"


def _events(block: ExportedBlock, logbook: Logbook, types: Mapping[int, int]) -> Iterator[str]:
    try:
        for event in logbook.event_data.events(block):
            description = words(event, logbook.telemetry, types.get(block.agent_id))
            yield f"{_time(event.timestamp_us, logbook)}  {description}"
    except SealedError:
        return  # the line of the block already states that it is sealed
    except MalformedEventsError as error:
        yield f"unreadable: {error}"


def _outside_chain(export: Export) -> str:
    waiting, stacked = len(export.blocks_to_be_committed), len(export.reconcile_stack)
    parts = (
        f"{_count(waiting, 'block')} to be committed" if waiting else "",
        f"{_count(stacked, 'block')} on the reconcile stack" if stacked else "",
    )
    return ", ".join(part for part in parts if part)


def _block_document(
    logbook: Logbook, block: ExportedBlock, decode: bool, types: Mapping[int, int]
) -> dict[str, object]:
    sealed = False
    try:
        events = logbook.event_data.events(block)
    except MalformedEventsError as error:
        events, sealed = None, isinstance(error, SealedError)
    return {
        "name": logbook.name(block.block_hash),
        "agent_id": block.agent_id,
        "timestamp_us": block.timestamp_us,
        "mission_s": logbook.mission_s(block.timestamp_us),
        "block_hash": block.block_hash,
        "chain_hash": block.chain_hash,
        "events": None
        if events is None
        else [_event_document(event, logbook, decode, types.get(block.agent_id)) for event in events],
        **({"sealed": True} if sealed else {}),
    }


def _event_document(event: LoggableEvent, logbook: Logbook, decode: bool, of_type: int | None) -> dict[str, object]:
    known: dict[str, Any] = {"timestamp_us": event.timestamp_us, "mission_s": logbook.mission_s(event.timestamp_us)}
    known |= {"event_id": event.event_id, "data": event.data.hex()}
    return {**known, "words": words(event, logbook.telemetry, of_type)} if decode else known


def _short(block_hash: str) -> str:
    return block_hash[:_HASH_DIGITS]


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
