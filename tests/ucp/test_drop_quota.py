"""Test the quota for dropped datagrams in the trace of an agent, with floods of datagrams."""

from collections import Counter
from itertools import pairwise

import pytest

from ucp._drop_quota import COUNTED_S, QUOTA_BYTES, DropQuota
from ucp.trace import DroppedDatagram, RecordedBytes

pytestmark = pytest.mark.any_user


def test_flood_takes_only_the_quota_and_each_datagram_is_counted() -> None:
    quota, written = DropQuota(), list[DroppedDatagram]()
    for number in range(100_000):
        reason = "wrong magic" if number % 3 else "truncated"
        written += quota.lines(DroppedDatagram(number / 1000, reason, RecordedBytes("A" * 1900)))
    written += quota.counts(100.0)
    counts: Counter[str] = Counter()
    for entry in written:
        counts[entry.dropped] += entry.count
    assert counts == {"wrong magic": 66_666, "truncated": 33_334}
    assert 0.99 * QUOTA_BYTES < sum(len(entry.to_line()) for entry in written) < QUOTA_BYTES + 100 * 128 + 5000
    assert max(after.t - before.t for before, after in pairwise(written)) <= COUNTED_S + 0.002


def test_few_dropped_datagrams_are_recorded_whole() -> None:
    entries = [DroppedDatagram(float(second), "replayed", RecordedBytes("A" * 1900)) for second in range(400)]
    quota = DropQuota()
    assert [line for entry in entries for line in quota.lines(entry)] == entries
    assert [*quota.counts(400.0)] == []
