"""Collect the records in a flight log, detect jumps of its clock, and convert its times to UTC. Count damaged parts.

A clock segment is the part of a log between two jumps of its clock. In each segment, times are converted by straight
lines through points. Each point is the median of GPS time in ten seconds. The median ignores single late or damaged
records. The lines account for the drift of the clock, and for a simulated vehicle that flies faster than real time.
"""

import math
from bisect import bisect_left
from collections.abc import Hashable
from dataclasses import dataclass
from statistics import median
from typing import Any, TypeVar

from harness.field.flight_logs._records import ClockJump, FlightRecord, GpsTime

MAX_RECORDS = 500_000
"""Maximum number of records that are stored from a file. A copter logs about 60,000 per hour."""
MAX_TIME_US = 2**53
_BACK_US, _AHEAD_US = 1_000_000, 60_000_000
_BIN_US = 10_000_000
_MAX_DRIFT = 0.01
"""Maximum relative difference between the rate of a real clock and the rate of GPS time. Rates of real clocks differ by
at most 0.0001, so a greater difference comes from a simulated vehicle that flies faster or slower than real time.
"""
_SECOND_US = 1_000_000
_UNKNOWN = object()

Kind = TypeVar("Kind", bound=FlightRecord)


class LogClock:
    """The clock of a flight log. If a single record has a wrong time, the object rejects the record. If several records
    have new times that are consistent with each other, the object assumes that the clock has jumped.
    """

    def __init__(self) -> None:
        self.jumps: list[ClockJump] = []
        self.dropped = 0
        self._last_us: int | None = None
        self._candidate_us: int | None = None

    @property
    def has_time(self) -> bool:
        return self._last_us is not None

    def accepts(self, at_us: int) -> bool:
        """Return true if a record with this time may be used. If the clock has jumped, add the jump to `jumps`."""
        if not 0 <= at_us <= MAX_TIME_US:
            self.dropped += 1
            return False
        if self._last_us is not None and not _consistent(self._last_us, at_us):
            if self._candidate_us is None or not _consistent(self._candidate_us, at_us):
                self._candidate_us = at_us
                self.dropped += 1
                return False
            self.jumps.append(ClockJump(self._last_us, at_us - self._last_us))
        self._last_us, self._candidate_us = at_us, None
        return True


def _consistent(before_us: int, after_us: int) -> bool:
    return -_BACK_US <= after_us - before_us <= _AHEAD_US


class RecordBudget:
    """A counter of the records that may still be stored from a file. All collectors of the file share this counter."""

    def __init__(self) -> None:
        self.left = MAX_RECORDS

    def take(self) -> bool:
        self.left -= 1
        return self.left >= 0


class RecordCollector:
    """A collector for the records of one source, such as a vehicle."""

    def __init__(self, budget: RecordBudget) -> None:
        self._budget = budget
        self._records: dict[type[Any], list[Any]] = {}
        self._converted: dict[type[Any], int] = {}
        self._times: dict[int, list[tuple[int, int]]] = {}
        self._last_sample: dict[Hashable, tuple[int, Hashable]] = {}
        self._last_state: dict[type[Any], Hashable] = {}

    def add(self, record: FlightRecord) -> bool:
        """Store a record. The method `end_segment` later converts its time to UTC. Return false if the maximum number
        of records has been stored already.
        """
        kept = self._budget.take()
        if kept:
            self._records.setdefault(type(record), []).append(record)
        return kept

    def add_gps_time(self, time: GpsTime) -> bool:
        """Store a GPS time, but at most one GPS time per second. Return true if the time was stored."""
        if not self._is_due(GpsTime, time.at_us, None) or not self.add(time):
            return False
        self.use_gps_time(time)
        return True

    def use_gps_time(self, time: GpsTime) -> None:
        """Use a GPS time to convert the times of this collector's records to UTC. The GPS time itself is not stored as
        a record.
        """
        self._times.setdefault(time.at_us // _BIN_US, []).append((time.at_us, time.utc_us))

    def add_sample(self, record: FlightRecord, source: Hashable, state: Hashable = None) -> None:
        """Store a record if the previous record from the same source is at least one second older, or has a different
        state.
        """
        if self._is_due((type(record), source), record.at_us, state):
            self.add(record)

    def add_change(self, record: FlightRecord, state: Hashable) -> None:
        """Store a record if its state differs from the state in the previous record of its type."""
        if self._last_state.get(type(record), _UNKNOWN) != state:
            self._last_state[type(record)] = state
            self.add(record)

    def _is_due(self, source: Hashable, at_us: int, state: Hashable) -> bool:
        last = self._last_sample.get(source)
        if last is not None and last[1] == state and 0 <= at_us - last[0] < _SECOND_US:
            return False
        self._last_sample[source] = (at_us, state)
        return True

    def end_segment(self) -> None:
        """End a segment of the log's clock, because the clock jumped or the log ended. Convert the times of all records
        of this segment to UTC, if the segment contains GPS times.
        """
        to_utc = (
            _PiecewiseLinearClock(
                [
                    (round(median(at for at, _ in times)), round(median(utc for _, utc in times)))
                    for _, times in sorted(self._times.items())
                ]
            )
            if self._times
            else None
        )
        self._times.clear()
        for kind, records in self._records.items():
            start = self._converted.get(kind, 0)
            self._converted[kind] = len(records)
            if kind is GpsTime or to_utc is None:
                continue
            for index in range(start, len(records)):
                records[index] = records[index]._replace(utc_us=to_utc(records[index].at_us))

    def records_of(self, kind: type[Kind]) -> list[Kind]:
        """Return the records of one type in the order of the file."""
        return self._records.get(kind, [])


class _PiecewiseLinearClock:
    """A conversion from the clock of a log to UTC, by straight lines through points (time on the log's clock, UTC). The
    first and the last line are extended beyond the first and the last point.
    """

    def __init__(self, points: list[tuple[int, int]]) -> None:
        self._points = points
        (first_at, first_utc), (last_at, last_utc) = points[0], points[-1]
        rate = (last_utc - first_utc) / (last_at - first_at) if last_at > first_at else 1.0
        self._rate = rate if abs(rate - 1) > _MAX_DRIFT else 1.0

    def __call__(self, at_us: int) -> int:
        after = bisect_left(self._points, (at_us, 0))
        if 0 < after < len(self._points):
            (before_at, before_utc), (after_at, after_utc) = self._points[after - 1 : after + 1]
            return before_utc + round((at_us - before_at) * (after_utc - before_utc) / (after_at - before_at))
        near_at, near_utc = self._points[min(after, len(self._points) - 1)]
        return near_utc + round((at_us - near_at) * self._rate)


_EPOCH_S = 315_964_800
"""The beginning of GPS time, 1980-01-06, in seconds since the Unix epoch."""
_WEEK_MS = 7 * 86_400_000
_LEAPS = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (1_230_768_000, 15), (1_136_073_600, 14))
"""Leap seconds as pairs: seconds since the Unix epoch, and GPS time minus UTC from this time on. The newest pair is
first (IERS Bulletin C).
"""
_OLDEST_S, _NEWEST_S = 1_136_073_600, 4_102_444_800
"""The years 2006 and 2100, as limits of a plausible time. Times outside of these limits come from damage, or from a
receiver without a fix.
"""


def gps_time_from_week(at_us: int, week: int, week_ms: int) -> GpsTime | None:
    """Return the GPS time for a GPS week and the milliseconds in this week. Return None if the time is impossible."""
    gps_ms = week * _WEEK_MS + week_ms
    unix_s = _EPOCH_S + gps_ms / 1000
    if not (_OLDEST_S <= unix_s <= _NEWEST_S and 0 <= week_ms < _WEEK_MS):
        return None
    leap_s = _leap_seconds(unix_s)
    return GpsTime(at_us, (_EPOCH_S - leap_s) * 1_000_000 + gps_ms * 1000, week, week_ms, leap_s)


def gps_time_from_utc(at_us: int, utc_us: int) -> GpsTime | None:
    """Return the GPS time for a time in UTC. Return None if the time is impossible."""
    if not _OLDEST_S <= utc_us / 1e6 <= _NEWEST_S:
        return None
    leap_s = _leap_seconds(utc_us / 1e6)
    week, week_ms = divmod(utc_us // 1000 - (_EPOCH_S - leap_s) * 1000, _WEEK_MS)
    return GpsTime(at_us, utc_us, week, week_ms, leap_s)


def _leap_seconds(unix_s: float) -> int:
    return next((leap_s for since_s, leap_s in _LEAPS if unix_s >= since_s), _LEAPS[-1][1])


MAX_SEARCHES = 500_000
"""Maximum number of times that the reader searches for the next message in a file."""
_NO_PLACE_DEG = 0.01
_ALTITUDES_M = (-1000.0, 100_000.0)


@dataclass
class DamagedBytes:
    """A counter of the bytes in a flight log that belong to no message."""

    searches: int = 0
    skipped_bytes: int = 0
    first_at: int | None = None
    ends_at: int | None = None
    """Position of the byte at which reading stopped because of too much damage, or None if the file was read to its
    end.
    """
    unusable: int = 0
    """Number of messages with an unknown layout or impossible values."""

    def skip(self, at: int, size: int) -> None:
        self.searches += 1
        self.skipped_bytes += size
        if self.first_at is None:
            self.first_at = at

    def ends_reading(self, at: int) -> bool:
        """Return true if the damage before the position `at` is so large that reading must stop."""
        if self.searches <= MAX_SEARCHES:
            return False
        self.ends_at = at
        return True

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of damage in a flight log."""
        sentences = []
        if self.skipped_bytes:
            sentences.append(
                f"{self.skipped_bytes:,} bytes are no whole message and are skipped, first at byte {self.first_at:,}"
            )
        if self.ends_at is not None:
            sentences.append(f"the part after byte {self.ends_at:,} is not read, because the file has too much damage")
        if self.unusable:
            messages = "1 message has" if self.unusable == 1 else f"{self.unusable:,} messages have"
            sentences.append(f"{messages} an unknown layout or impossible values and are left out")
        return sentences


def is_place(lat_deg: float, lon_deg: float, alt_m: float) -> bool:
    """Return true if these values are a position on Earth.

    A place near 0° N, 0° E does not count, because vehicles report it while they do not know their position.
    """
    return (
        -90 <= lat_deg <= 90
        and -180 <= lon_deg <= 180
        and _ALTITUDES_M[0] <= alt_m <= _ALTITUDES_M[1]
        and math.hypot(lat_deg, lon_deg) > _NO_PLACE_DEG
    )
