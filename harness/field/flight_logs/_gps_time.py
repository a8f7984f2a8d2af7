"""Convert GPS time, which consists of weeks, milliseconds and leap seconds."""

from harness.field.flight_logs._records import GpsTime

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


def from_week(at_us: int, week: int, week_ms: int) -> GpsTime | None:
    """Return the GPS time for a GPS week and the milliseconds in this week. Return None if the time is impossible."""
    gps_ms = week * _WEEK_MS + week_ms
    unix_s = _EPOCH_S + gps_ms / 1000
    if not (_OLDEST_S <= unix_s <= _NEWEST_S and 0 <= week_ms < _WEEK_MS):
        return None
    leap_s = _leap_seconds(unix_s)
    return GpsTime(at_us, (_EPOCH_S - leap_s) * 1_000_000 + gps_ms * 1000, week, week_ms, leap_s)


def from_utc(at_us: int, utc_us: int) -> GpsTime | None:
    """Return the GPS time for a time in UTC. Return None if the time is impossible."""
    if not _OLDEST_S <= utc_us / 1e6 <= _NEWEST_S:
        return None
    leap_s = _leap_seconds(utc_us / 1e6)
    week, week_ms = divmod(utc_us // 1000 - (_EPOCH_S - leap_s) * 1000, _WEEK_MS)
    return GpsTime(at_us, utc_us, week, week_ms, leap_s)


def _leap_seconds(unix_s: float) -> int:
    return next((leap_s for since_s, leap_s in _LEAPS if unix_s >= since_s), _LEAPS[-1][1])
