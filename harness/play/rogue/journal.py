"""The rogue node's journal, `rogue.jsonl`, and the sequence numbers that identify an injection.

Of one injection the first LINES datagrams have a line each. Those after them are counted by mission second: their line
has `count` and `bytes`, and `messages` and `refused` by type and reason.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

from harness.play.rogue.rogue import RogueDatagram
from ucp.messages import MalformedDatagramError, block_named, decode
from ucp.secure.envelope import NAMES, read_clear
from ucp.secure.envelope import VERSION as SECURED

LINES = 2000


class Journal:
    def __init__(self, write: Callable[[dict[str, Any]], None]) -> None:
        self._write = write
        self._lines: Counter[int] = Counter()
        self._counted: dict[int, dict[str, Any]] = {}
        """The line of each injection that is not written yet."""

    def add(self, injected: RogueDatagram, at_s: float) -> None:
        number, record = injected.injection, injected.to_json(at_s)
        self._lines[number] += 1
        if self._lines[number] <= LINES:
            self._write(record)
            return
        second = int(at_s)
        counted = self._counted.get(number)
        if counted is None or counted["at_s"] != second:
            self._flush(number)
            counted = self._counted[number] = {"at_s": second, "injection": number, "what": injected.what}
            counted |= {"count": 0, "bytes": 0, "messages": Counter(), "refused": Counter()}
        counted["count"] += 1
        counted["bytes"] += record["bytes"]
        kind, of = ("refused", record["refused"]) if "refused" in record else ("messages", record["message"])
        counted[kind][of] += 1

    def close(self) -> None:
        for number in list(self._counted):
            self._flush(number)

    def _flush(self, number: int) -> None:
        if counted := self._counted.pop(number, None):
            self._write(counted)


OF_NO_INJECTION = -1
"""The number of the injection of a datagram that the scenario itself has (`harness.scenario.injection`)."""


def line_of(at_s: float, injection: int, what: str, source: int, datagram: bytes) -> dict[str, Any]:
    """The record of a datagram, sent at `at_s`; `refused` is why no agent would take it for a message."""
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


def _secured(datagram: bytes) -> dict[str, Any]:
    """What is in clear of a sealed datagram."""
    try:
        clear = read_clear(datagram)
    except MalformedDatagramError as malformed:
        return {"refused": malformed.reason}
    if clear.type not in NAMES:
        return {"refused": "a revocation"}
    return {"message": NAMES[clear.type], "sender": clear.sender, "sequence": clear.sequence, "block": None}


FORGED_FROM = 1 << 31
"""No agent counts its datagrams up to this; from here on they are the rogue's."""
_EACH = 1 << 17
"""Of one injection: more than a flood has datagrams."""


def forged_sequence(injection: int, count: int) -> int:
    """That of the datagram with this count, from 0, of the injection with this number, from 1."""
    return FORGED_FROM + (injection - 1) * _EACH + count % _EACH


def injection_of(sequence: int) -> int | None:
    """The number of the injection that forged the datagram; None if an agent sent it."""
    return (sequence - FORGED_FROM) // _EACH + 1 if sequence >= FORGED_FROM else None
