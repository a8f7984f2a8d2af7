"""Describe the motion of vehicles as sequences of segments. Each segment is a formula that computes the position from
the time since the beginning of the segment. The formulas simulate neither forces nor time steps, so a position does not
depend on how often a program computes it. For example, a process that wakes only every twenty simulated seconds
computes the same track as a simulation in virtual time. The motions of copters, planes and rovers are in _copter.py,
_plane.py and _rover.py.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

GRAVITY_MS2 = 9.81
NEAR_M = 1e-6  # a vehicle at this distance has reached a place


class LocalPlace(NamedTuple):
    """A place in metres from home."""

    north_m: float
    east_m: float
    up_m: float


@dataclass(frozen=True)
class MotionState:
    """The position and movement of a vehicle relative to home, in metres, metres per second and radians."""

    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0
    north_ms: float = 0.0
    east_ms: float = 0.0
    up_ms: float = 0.0
    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    yaw_rate_rads: float = 0.0

    @property
    def point(self) -> LocalPlace:
        return LocalPlace(self.north_m, self.east_m, self.up_m)

    @property
    def halted(self) -> MotionState:
        """Return the same position and heading without movement."""
        return MotionState(self.north_m, self.east_m, self.up_m, yaw_rad=self.yaw_rad)


class MotionSegment(Protocol):
    """One segment of a motion."""

    @property
    def duration_s(self) -> float:
        """The duration of the segment in seconds, or math.inf if it has no end."""

    def at(self, since_s: float) -> MotionState:
        """Return the motion at a time in seconds after the beginning of the segment. The time is from 0 to
        `duration_s`.
        """


class RestSegment:
    """A segment without movement."""

    def __init__(self, start: MotionState, duration_s: float = math.inf) -> None:
        self.duration_s = duration_s
        self._motion = start.halted

    def at(self, since_s: float) -> MotionState:
        return self._motion


class StraightLine:
    """A straight line. At the beginning, the speed changes from `from_ms` to `speed_ms`. At the end it changes to
    `to_ms`. Both changes have the acceleration `accel_ms2`. On a short line, the vehicle does not reach `speed_ms`. The
    line must be long enough for the change from `from_ms` to `to_ms`. The heading is the direction of the line. On a
    vertical line, the heading does not change.
    """

    def __init__(
        self,
        start: MotionState,
        end: LocalPlace,
        speed_ms: float,
        accel_ms2: float,
        from_ms: float = 0.0,
        to_ms: float = 0.0,
    ) -> None:
        north, east, up = (there - here for here, there in zip(start.point, end, strict=True))
        self._start, self._end = start, end
        self._length_m = math.hypot(north, east, up)
        self._along = LocalPlace(*(part / max(self._length_m, NEAR_M) for part in (north, east, up)))
        self._yaw_rad = math.atan2(east, north) % math.tau if math.hypot(north, east) > NEAR_M else start.yaw_rad
        self._from_ms, self._accel_ms2 = from_ms, accel_ms2
        peak_ms = math.sqrt(accel_ms2 * self._length_m + (from_ms**2 + to_ms**2) / 2)
        self._top_ms = min(speed_ms, peak_ms)
        self._speeding_up_s = (self._top_ms - from_ms) / accel_ms2
        slowing_s = (self._top_ms - to_ms) / accel_ms2
        ramps_m = self._speeding_up_s * (self._top_ms + from_ms) / 2 + slowing_s * (self._top_ms + to_ms) / 2
        steady_s = max(0.0, self._length_m - ramps_m) / self._top_ms if self._top_ms else 0.0
        self._slowing_from_s = self._speeding_up_s + steady_s
        self.duration_s = self._slowing_from_s + slowing_s

    def at(self, since_s: float) -> MotionState:
        speeding_s = min(since_s, self._speeding_up_s)
        steady_s = min(since_s, self._slowing_from_s) - speeding_s
        slowing_s = max(0.0, since_s - self._slowing_from_s)
        ramp = self._accel_ms2 / 2
        gone_m = self._from_ms * speeding_s + ramp * speeding_s**2 + self._top_ms * (steady_s + slowing_s)
        gone_m = min(self._length_m, gone_m - ramp * slowing_s**2)
        speed_ms = self._from_ms + self._accel_ms2 * (speeding_s - slowing_s)
        place = self._end
        if since_s < self.duration_s:
            place = LocalPlace(*(was + part * gone_m for was, part in zip(self._start.point, self._along, strict=True)))
        north_ms, east_ms, up_ms = (part * speed_ms for part in self._along)
        return MotionState(*place, north_ms, east_ms, up_ms, yaw_rad=self._yaw_rad)


class CircularArc:
    """A part of a level circle at constant speed. `turn_rad` is positive clockwise, and may be infinite."""

    def __init__(self, start: MotionState, centre: tuple[float, float], turn_rad: float, speed_ms: float) -> None:
        north, east = start.north_m - centre[0], start.east_m - centre[1]
        self._centre, self._up_m = centre, start.up_m
        self._radius_m = math.hypot(north, east)
        self._bearing_rad = math.atan2(east, north)
        self._rate_rads = math.copysign(speed_ms / self._radius_m, turn_rad)
        self._speed_ms = speed_ms
        self.duration_s = turn_rad / self._rate_rads

    def at(self, since_s: float) -> MotionState:
        bearing = self._bearing_rad + self._rate_rads * since_s
        yaw = bearing + math.copysign(math.pi / 2, self._rate_rads)
        return MotionState(
            self._centre[0] + self._radius_m * math.cos(bearing),
            self._centre[1] + self._radius_m * math.sin(bearing),
            self._up_m,
            self._speed_ms * math.cos(yaw),
            self._speed_ms * math.sin(yaw),
            roll_rad=math.atan(self._speed_ms * self._rate_rads / GRAVITY_MS2),
            yaw_rad=yaw % math.tau,
            yaw_rate_rads=self._rate_rads,
        )


class ClimbingSegment:
    """A level segment with an additional climb or descent to the altitude `up_m`, at the vertical speed `rate_ms`."""

    def __init__(self, level: MotionSegment, up_m: float, rate_ms: float) -> None:
        self._level, self._up_m = level, up_m
        self._from_m = level.at(0.0).up_m
        self._rate_ms = math.copysign(rate_ms, up_m - self._from_m)
        self._climbs_s = (up_m - self._from_m) / self._rate_ms if rate_ms else 0.0
        self.duration_s = level.duration_s

    def at(self, since_s: float) -> MotionState:
        if since_s < self._climbs_s:
            climbed_m = self._rate_ms * since_s
            return replace(self._level.at(since_s), up_m=self._from_m + climbed_m, up_ms=self._rate_ms)
        return replace(self._level.at(since_s), up_m=self._up_m)


class FallSegment:
    """A fall to the ground without power and air resistance."""

    def __init__(self, start: MotionState) -> None:
        self._start = start
        self.duration_s = (start.up_ms + math.sqrt(start.up_ms**2 + 2 * GRAVITY_MS2 * start.up_m)) / GRAVITY_MS2

    @property
    def impact_ms(self) -> float:
        """The downward speed at the ground."""
        return GRAVITY_MS2 * self.duration_s - self._start.up_ms

    def at(self, since_s: float) -> MotionState:
        start = self._start
        up_m = start.up_m + start.up_ms * since_s - GRAVITY_MS2 * since_s**2 / 2 if since_s < self.duration_s else 0.0
        return replace(
            start,
            north_m=start.north_m + start.north_ms * since_s,
            east_m=start.east_m + start.east_ms * since_s,
            up_m=max(0.0, up_m),
            up_ms=start.up_ms - GRAVITY_MS2 * since_s,
        )


class PlannedMotion:
    """A sequence of segments that begins at `begin_s`. All times are seconds of one clock, which the caller chooses."""

    def __init__(self, begin_s: float, segments: Sequence[MotionSegment]) -> None:
        """Create a motion from at least one segment. Only the last segment may be infinite."""
        self._segments = segments
        *self._begin_s, self.end_s = itertools.accumulate((part.duration_s for part in segments), initial=begin_s)

    @property
    def rests_from_s(self) -> float:
        """The time at which the vehicle stops moving for good. It is infinity if the vehicle never stops."""
        return self._begin_s[-1] if isinstance(self._segments[-1], RestSegment) else self.end_s

    def at(self, now_s: float) -> MotionState:
        """Return the motion at the time `now_s`. For a time outside the sequence, return the motion at its nearer
        end.
        """
        index = max(0, bisect.bisect_right(self._begin_s, now_s) - 1)
        segment = self._segments[index]
        return segment.at(min(max(0.0, now_s - self._begin_s[index]), segment.duration_s))


class MotionInterval:
    """A part of the motion `course`, from `begin_s` to `end_s` on the clock of `course`."""

    def __init__(self, course: PlannedMotion, begin_s: float, end_s: float) -> None:
        self._course, self._begin_s = course, begin_s
        self.duration_s = end_s - begin_s

    def at(self, since_s: float) -> MotionState:
        return self._course.at(self._begin_s + since_s)


def end_of(segments: Sequence[MotionSegment]) -> MotionState:
    """Return the motion at the end of the last segment."""
    return segments[-1].at(segments[-1].duration_s)
