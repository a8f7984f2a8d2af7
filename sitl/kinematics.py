"""How the embedded vehicle moves: a copter without dynamics, and without a clock of its own.

It climbs at a bounded rate, spirals out to a circle round its home, and lands where it is. Every phase is a closed
formula of the time since it began, so `advance` may be called at any step, however coarse: at a speedup of 20 the
vehicle wakes once in a simulated second and still flies the same track.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

CLIMB_MS = 2.5  # ArduPilot's default climb, WPNAV_SPEED_UP
DESCENT_MS = 1.0
CIRCLE_RADIUS_M = 30.0
CIRCLE_SPEED_MS = 5.0
CIRCLE_RATE_RADS = CIRCLE_SPEED_MS / CIRCLE_RADIUS_M
GRAVITY_MS2 = 9.81


class Phase(enum.Enum):
    """What the copter is doing."""

    GROUND = "on the ground"
    CLIMB = "climbing"
    CIRCLE = "circling"
    LAND = "landing"


@dataclass(frozen=True)
class Motion:
    """Where the copter is relative to home, and how it moves: metres, metres per second, radians, all finite."""

    north_m: float = 0.0
    east_m: float = 0.0
    up_m: float = 0.0
    north_ms: float = 0.0
    east_ms: float = 0.0
    up_ms: float = 0.0
    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    yaw_rate_rads: float = 0.0


class Copter:
    """A copter that stands, climbs, circles or lands. Times are simulated seconds and never go back."""

    def __init__(self, heading_deg: float) -> None:
        self.phase = Phase.GROUND
        self.motion = Motion(yaw_rad=math.radians(heading_deg))
        self._began_s = 0.0
        self._from = self.motion  # where the phase began
        self._altitude_m = 0.0

    def take_off(self, altitude_m: float, now_s: float) -> None:
        """Climb to `altitude_m` above home (> 0), then circle."""
        self.advance(now_s)
        self._altitude_m = altitude_m
        self._begin(Phase.CLIMB, now_s)

    def land(self, now_s: float) -> None:
        """Descend right here, to the ground."""
        self.advance(now_s)
        if self.phase is not Phase.GROUND:
            self._begin(Phase.LAND, now_s)

    def hold(self, now_s: float) -> None:
        """Break off a landing: circle at the altitude reached."""
        self.advance(now_s)
        if self.phase is Phase.LAND:
            self._begin(Phase.CIRCLE, now_s)

    def advance(self, now_s: float) -> None:
        """Move to where the copter is at `now_s`."""
        if self.phase is Phase.CLIMB:
            arrives_s = self._began_s + max(0.0, self._altitude_m - self._from.up_m) / CLIMB_MS
            if now_s < arrives_s:
                self.motion = self._vertical(now_s, CLIMB_MS)
                return
            self.motion = self._vertical(arrives_s, CLIMB_MS)
            self._begin(Phase.CIRCLE, arrives_s)
        if self.phase is Phase.LAND:
            lands_s = self._began_s + self._from.up_m / DESCENT_MS
            if now_s < lands_s:
                self.motion = self._vertical(now_s, -DESCENT_MS)
                return
            still = self._from
            self.motion = Motion(still.north_m, still.east_m, 0.0, yaw_rad=still.yaw_rad)
            self._begin(Phase.GROUND, lands_s)
        if self.phase is Phase.CIRCLE:
            self.motion = self._circle(now_s)

    def _begin(self, phase: Phase, at_s: float) -> None:
        self.phase, self._began_s, self._from = phase, at_s, self.motion

    def _vertical(self, now_s: float, up_ms: float) -> Motion:
        start = self._from
        up_m = start.up_m + up_ms * (now_s - self._began_s)
        return Motion(start.north_m, start.east_m, up_m, up_ms=up_ms, yaw_rad=start.yaw_rad)

    def _circle(self, now_s: float) -> Motion:
        """Go round home at a constant angular rate while the radius grows, or shrinks, to that of the circle."""
        start, since_s = self._from, now_s - self._began_s
        radius_0 = math.hypot(start.north_m, start.east_m)
        missing = CIRCLE_RADIUS_M - radius_0
        outward_ms = math.copysign(CIRCLE_SPEED_MS, missing) if abs(missing) > CIRCLE_SPEED_MS * since_s else 0.0
        radius = radius_0 + outward_ms * since_s if outward_ms else CIRCLE_RADIUS_M
        bearing_0 = math.atan2(start.east_m, start.north_m) if radius_0 else start.yaw_rad
        bearing = bearing_0 + CIRCLE_RATE_RADS * since_s
        cos, sin = math.cos(bearing), math.sin(bearing)
        around_ms = CIRCLE_RATE_RADS * radius
        north_ms = outward_ms * cos - around_ms * sin
        east_ms = outward_ms * sin + around_ms * cos
        return Motion(
            north_m=radius * cos,
            east_m=radius * sin,
            up_m=start.up_m,
            north_ms=north_ms,
            east_ms=east_ms,
            roll_rad=math.atan(around_ms * CIRCLE_RATE_RADS / GRAVITY_MS2),
            yaw_rad=math.atan2(east_ms, north_ms) % math.tau,
            yaw_rate_rads=CIRCLE_RATE_RADS,
        )
