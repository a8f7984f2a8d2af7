"""Define the lines of the log `rogue.jsonl`, and the sequence numbers that mark forged messages."""

from ucp.messages import MalformedDatagramError, block_named, decode
from ucp.secure.envelope import CONTROL_NAMES, NAMES, read_clear_header
from ucp.secure.envelope import VERSION as SECURED

OF_NO_INJECTION = -1
"""The number in the log for datagrams that no injection caused. The scenario contains such a datagram itself
(`harness.scenario.injection`).
"""


def line_of(at_s: float, injection: int, what: str, source: int, datagram: bytes) -> dict[str, object]:
    """Return the log entry of a datagram that was sent at `at_s`. The field `refused` of the entry is the reason why
    agents drop the datagram.
    """
    record = {"at_s": round(at_s, 6), "injection": injection, "what": what, "source": source}
    if datagram[2:3] == bytes([SECURED]):
        return {**record, "bytes": len(datagram), **_secured(datagram)}
    try:
        sender, sequence, message = decode(datagram)
    except MalformedDatagramError as malformed:
        return {**record, "bytes": len(datagram), "refused": malformed.reason}
    block = block_named(message)
    decoded = {"message": message.NAME, "sender": sender, "sequence": sequence}
    return {**record, **decoded, "block": block.hex() if block else None, "bytes": len(datagram)}


def _secured(datagram: bytes) -> dict[str, object]:
    """Return the unencrypted fields of an encrypted datagram."""
    try:
        clear = read_clear_header(datagram)
    except MalformedDatagramError as malformed:
        return {"refused": malformed.reason}
    if clear.type in CONTROL_NAMES:
        return {"refused": f"no message: {CONTROL_NAMES[clear.type]}"}
    return {"message": NAMES[clear.type], "sender": clear.sender, "sequence": clear.sequence, "block": None}


FORGED_FROM = 1 << 31
"""First sequence number of forged datagrams. It is so high that agents never reach it."""
_EACH = 1 << 17
"""Number of sequence numbers that each injection may use. Even a flood has fewer datagrams."""


def forged_sequence(injection: int, count: int) -> int:
    """Return the sequence number of datagram number `count` (from 0) of injection number `injection` (from 1)."""
    return FORGED_FROM + (injection - 1) * _EACH + count % _EACH


def injection_of(sequence: int) -> int | None:
    """Return the number of the injection that created a datagram. Return None if an agent sent the datagram."""
    return (sequence - FORGED_FROM) // _EACH + 1 if sequence >= FORGED_FROM else None
