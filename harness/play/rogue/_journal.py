"""Write `rogue.jsonl`, the log of the datagrams that the rogue node sends.

The first LINES datagrams of an injection have one line each. Later datagrams are counted by mission second. A line of
such counts has the keys `count` and `bytes`, `messages` by message type, and `refused` by reason.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

from harness.play.rogue._rogue import RogueDatagram

LINES = 2000


class RogueJournal:
    def __init__(self, write: Callable[[dict[str, object]], None]) -> None:
        self._write = write
        self._lines: Counter[int] = Counter()
        self._counted: dict[int, dict[str, Any]] = {}
        """Number of an injection -> the line of counts for the current mission second, which is not written yet."""

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
