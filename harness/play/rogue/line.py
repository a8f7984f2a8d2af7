"""A line of `rogue.jsonl`: a datagram on the air that no agent has sent."""

from typing import Any

from ucp.messages import MalformedDatagramError, block_named, decode

OF_NO_INJECTION = -1
"""The number of the injection of a datagram that the scenario itself has (`harness.scenario.datagrams`)."""


def line_of(at_s: float, injection: int, what: str, source: int, datagram: bytes) -> dict[str, Any]:
    """The record of a datagram, sent at `at_s`; `refused` is why no agent would take it for a message."""
    record = {"at_s": round(at_s, 6), "injection": injection, "what": what, "source": source}
    try:
        sender, sequence, message = decode(datagram)
    except MalformedDatagramError as malformed:
        return {**record, "bytes": len(datagram), "refused": malformed.reason}
    block = block_named(message)
    decoded = {"message": message.NAME, "sender": sender, "sequence": sequence}
    return {**record, **decoded, "block": block.hex() if block else None, "bytes": len(datagram)}
