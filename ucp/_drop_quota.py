"""Limit the number of bytes that dropped datagrams add to the trace, because any sender can send such datagrams.
Without a limit, a flood of dropped datagrams would fill the disk of a vehicle. The agent therefore writes complete
datagrams only within a quota. It counts the other datagrams and writes their number. The trace therefore contains or
counts each datagram, and a flood does not make the trace much larger.
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
    """A quota for dropped datagrams in a trace. Datagrams within the quota are written completely, and all others are
    only counted.
    """

    def __init__(self) -> None:
        self._left_bytes = float(QUOTA_BYTES)
        self._at_s = self._counted_at_s = 0.0
        self._counts: Counter[str] = Counter()

    def lines(self, entry: DroppedDatagram) -> Iterator[DroppedDatagram]:
        """Yield the trace entries to write now, after a datagram was dropped. `entry` describes this datagram. If
        `entry` is within the quota, yield it. Otherwise, only count the datagram. If counts are due, yield them at the
        end.
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
        """Yield one entry for each reason for a drop. The entry contains the number of datagrams that were dropped for
        this reason since the previous count and have no entry of their own.
        """
        self._counted_at_s = t
        for reason, count in self._counts.items():
            yield DroppedDatagram(t, reason, RecordedBytes(""), count)
        self._counts.clear()
