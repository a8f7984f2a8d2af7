"""A limit for the size of dropped datagrams in the trace, because any sender can send such datagrams.

A flood of datagrams that are dropped would fill the disk of a vehicle. The agent therefore writes complete datagrams
only within a quota. It counts the other datagrams and writes their number. The trace thus contains or counts each
datagram, and its size does not depend on the flood.
"""

from collections import Counter
from collections.abc import Iterator

from ucp.trace import DroppedDatagram, RecordedBytes

QUOTA_BYTES = 1024 * 1024
BYTES_PER_S = 128
"""Growth of the quota in bytes per mission second. Because the quota grows, the trace of a long flood contains samples
of the flood.
"""
COUNTED_S = 10.0
"""Minimum number of mission seconds between two counts of dropped datagrams with the same reason."""
LINE_BYTES = 80
"""Assumed size of a trace line without its datagram."""


class DropQuota:
    """Choose the dropped datagrams that the trace contains completely, and count the others."""

    def __init__(self) -> None:
        self._left_bytes = float(QUOTA_BYTES)
        self._at_s = self._counted_at_s = 0.0
        self._counts: Counter[str] = Counter()

    def lines(self, entry: DroppedDatagram) -> Iterator[DroppedDatagram]:
        """Yield the trace entries to write now: this dropped datagram if it is within the quota, and the counts that
        are due.
        """
        self._left_bytes = min(QUOTA_BYTES, self._left_bytes + (entry.t - self._at_s) * BYTES_PER_S)
        self._at_s = entry.t
        size = LINE_BYTES + len(entry.datagram.text)
        if size <= self._left_bytes:
            self._left_bytes -= size
            yield entry
        else:
            self._counts[entry.dropped] += 1
        if self._counts and entry.t >= self._counted_at_s + COUNTED_S:
            yield from self.counts(entry.t)

    def counts(self, t: float) -> Iterator[DroppedDatagram]:
        """Yield one entry per reason with the number of datagrams that were dropped and not written since the last
        count.
        """
        self._counted_at_s = t
        for reason, count in self._counts.items():
            yield DroppedDatagram(t, reason, RecordedBytes(""), count)
        self._counts.clear()
