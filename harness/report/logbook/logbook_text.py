"""The logbook as text for people, and as JSON for programs."""

from collections.abc import Iterator
from typing import Any

from harness.archive.event_data import EventData, SealedError
from harness.archive.exports import Export, ExportedBlock
from harness.present.text import moment
from harness.report.logbook.book import Logbook
from ucp.events import LoggableEvent, MalformedEventsError
from ucp.telemetry import describe

_HASH_DIGITS = 12
_BYTES_SHOWN = 8


def lines(logbook: Logbook, decode: bool) -> Iterator[str]:
    """Yield the lines of each agent's chain, oldest block first. With `decode`, each event is described."""
    for agent_id, export in logbook.exports.items():
        yield f"agent {agent_id}: a chain of {_count(len(export.chain), 'block')}, top {_short(export.top_chain_hash)}"
        names = [logbook.name(block.block_hash) for block in export.chain]
        width = max(map(len, names), default=0)
        for name, block in zip(names, export.chain, strict=True):
            yield f"  {name:<{width}}  {_block(block, logbook.event_data)}"
            if decode:
                yield from (f"    {line}" for line in _events(block, logbook))
        if outside := _outside_chain(export):
            yield f"  beside the chain: {outside}"


def document(logbook: Logbook, decode: bool) -> dict[str, Any]:
    """Return the logbook as a JSON document. Data and hashes are hexadecimal, times are microseconds.

    `events` is null for a block whose events are unreadable or sealed.
    """
    return {
        "source": "mavlink" if logbook.telemetry else "random or scripted",
        "agents": {
            str(agent_id): {
                "top_chain_hash": export.top_chain_hash,
                "chain": [_block_document(logbook, block, decode) for block in export.chain],
            }
            for agent_id, export in logbook.exports.items()
        },
        "errors": [*logbook.absent.values(), *logbook.errors],
    }


def words(event: LoggableEvent, telemetry: bool) -> str:
    """Return a description of an event."""
    description = describe(event.event_id, event.data) if telemetry else ""
    if description and description != "unreadable":
        return description
    shown = event.data[:_BYTES_SHOWN].hex() + ("…" if len(event.data) > _BYTES_SHOWN else "")
    raw = f"event {event.event_id}, {_count(len(event.data), 'byte')}" + (f": {shown}" if shown else "")
    return f"{description}: {raw}" if description else raw


def _block(block: ExportedBlock, event_data: EventData) -> str:
    try:
        events = _count(len(event_data.events(block)), "event")
    except SealedError as sealed:
        events = str(sealed)
    except MalformedEventsError:
        events = "unreadable events"
    return f"{moment(block.timestamp_us)}  {_short(block.block_hash)}  {events}"


def _events(block: ExportedBlock, logbook: Logbook) -> Iterator[str]:
    try:
        for event in logbook.event_data.events(block):
            yield f"{moment(event.timestamp_us)}  {words(event, logbook.telemetry)}"
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


def _block_document(logbook: Logbook, block: ExportedBlock, decode: bool) -> dict[str, Any]:
    sealed = False
    try:
        events = logbook.event_data.events(block)
    except MalformedEventsError as error:
        events, sealed = None, isinstance(error, SealedError)
    return {
        "name": logbook.name(block.block_hash),
        "agent_id": block.agent_id,
        "timestamp_us": block.timestamp_us,
        "block_hash": block.block_hash,
        "chain_hash": block.chain_hash,
        "events": None if events is None else [_event_document(event, logbook.telemetry, decode) for event in events],
        **({"sealed": True} if sealed else {}),
    }


def _event_document(event: LoggableEvent, telemetry: bool, decode: bool) -> dict[str, Any]:
    known = {"timestamp_us": event.timestamp_us, "event_id": event.event_id, "data": event.data.hex()}
    return {**known, "words": words(event, telemetry)} if decode else known


def _short(block_hash: str) -> str:
    return block_hash[:_HASH_DIGITS]


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
