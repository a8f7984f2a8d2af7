"""What all flights have in common: steps, and the question which one comes next.

A flight is not a script. At every heartbeat the pilot asks: what is the next step that this vehicle has not made? A
vehicle that acknowledges a mode and undoes it, or disarms itself while the machine was busy, both of which ArduPilot
does, is simply asked again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._pilot_link import Link
from sitl._vehicle_state import VehicleState
from sitl.modes import MODES
from sitl.vehicle import VehicleType

STEP_LIMIT_S = 60.0
READY_FOR_S = 3.0
READY_LIMIT_S = 180.0  # ArduPilot calibrates, and waits for its estimates to agree


@dataclass(frozen=True)
class Step:
    """Something to wait for, as an error names it, and for how many simulated seconds, all attempts together."""

    name: str
    limit_s: float = STEP_LIMIT_S


HEARTBEAT = Step("the first heartbeat")
READY = Step("ready to arm", READY_LIMIT_S)
ARM = Step("arming")
STAY_READY = Step("ready to arm, and not only for a moment", READY_LIMIT_S)


class HopelessError(Exception):
    """The flight cannot go on; the message says why."""


class Procedure(Protocol):
    """One thing that a pilot makes a vehicle do, `purpose` in words."""

    purpose: str

    def next_step(self) -> Step | None:
        """The first step that is not made, None when all are. Raises HopelessError."""

    def ask(self, step: Step) -> None:
        """Ask the vehicle for a step; called once at every heartbeat while it is not made."""


class GettingReady:
    """Of a flight all that comes before arming, until there has been nothing of that left for READY_FOR_S."""

    purpose = "get ready"

    def __init__(self, flight: Procedure, state: VehicleState) -> None:
        self._flight = flight
        self._state = state
        self._since_s: float | None = None  # simulated

    def next_step(self) -> Step | None:
        step, now_s = self._flight.next_step(), self._state.time_s
        if step is not None and step is not ARM:
            self._since_s = None
            return step
        if now_s is None or self._since_s is None or now_s < self._since_s:
            self._since_s = now_s
        if now_s is None or self._since_s is None or now_s - self._since_s < READY_FOR_S:
            return STAY_READY
        return None

    def ask(self, step: Step) -> None:
        if step is not STAY_READY:
            self._flight.ask(step)


class Commander:
    """The requests that every procedure makes."""

    def __init__(self, link: Link, vehicle_type: VehicleType) -> None:
        self.link = link
        self.state = link.state
        self.vehicle_type: VehicleType = vehicle_type

    def in_mode(self, name: str) -> bool:
        return self.state.mode == MODES[self.vehicle_type][name]

    def set_mode(self, name: str) -> None:
        self.link.ask_for_mode(MODES[self.vehicle_type][name])

    def arming(self) -> Step | None:
        """The step towards being armed that is not made."""
        if self.state.armed:
            return None
        return ARM if self.state.ready_to_arm and self.state.position else READY

    def arm(self) -> None:
        self.link.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def accepted(self, command: int) -> bool:
        return self.link.acks.get(command) == int(mavlink.MAV_RESULT_ACCEPTED)

    def refused(self, commands: Sequence[int]) -> bool:
        """Whether one of these was answered with MAV_RESULT_FAILED; each answer counts once."""
        failed = [command for command in commands if self.link.acks.get(command) == int(mavlink.MAV_RESULT_FAILED)]
        for command in failed:
            del self.link.acks[command]
        return bool(failed)
