"""Define steps and procedures, which all flights use.

A flight is not a fixed sequence of commands. At each heartbeat the pilot determines the first step that is not
complete, and requests it. ArduPilot may acknowledge a mode and then leave it, or disarm by itself on a busy machine.
The pilot then requests the step again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl._pilot_link import PilotLink
from sitl._vehicle_state import VehicleState
from sitl.modes import MODES
from sitl.vehicle import VehicleType

STEP_LIMIT_S = 60.0
READY_FOR_S = 3.0
READY_LIMIT_S = 180.0  # ArduPilot calibrates, and waits for its estimates to agree


@dataclass(frozen=True)
class ProcedureStep:
    """A step of a procedure, with its name for error messages and its time limit in simulated seconds."""

    name: str
    limit_s: float = STEP_LIMIT_S


HEARTBEAT = ProcedureStep("the first heartbeat")
READY = ProcedureStep("ready to arm", READY_LIMIT_S)
ARM = ProcedureStep("arming")
STAY_READY = ProcedureStep("ready to arm, and not only for a moment", READY_LIMIT_S)


class HopelessError(Exception):
    """An error: the flight cannot continue. The message contains the reason."""


class PilotProcedure(Protocol):
    """A procedure that a pilot executes. `purpose` is its purpose as a verb phrase. Error messages contain it after
    "did not".
    """

    purpose: str

    def next_step(self) -> ProcedureStep | None:
        """Return the first incomplete step. Return None if all steps are complete. Raises HopelessError."""

    def ask(self, step: ProcedureStep) -> None:
        """Request a step from the vehicle. The pilot calls this once per heartbeat until the step is complete."""


class ArmingPreparation:
    """The steps before arming. The preparation ends when all steps have stayed complete for READY_FOR_S seconds."""

    purpose = "get ready"

    def __init__(self, flight: PilotProcedure, state: VehicleState) -> None:
        self._flight = flight
        self._state = state
        self._since_s: float | None = None  # simulated

    def next_step(self) -> ProcedureStep | None:
        step, now_s = self._flight.next_step(), self._state.time_s
        if step is not None and step is not ARM:
            self._since_s = None
            return step
        if now_s is None or self._since_s is None or now_s < self._since_s:
            self._since_s = now_s
        if now_s is None or self._since_s is None or now_s - self._since_s < READY_FOR_S:
            return STAY_READY
        return None

    def ask(self, step: ProcedureStep) -> None:
        if step is not STAY_READY:
            self._flight.ask(step)


class Commander:
    """The commands to a vehicle that all procedures share, such as arming it."""

    def __init__(self, link: PilotLink, vehicle_type: VehicleType) -> None:
        self.link = link
        self.state = link.state
        self.vehicle_type: VehicleType = vehicle_type

    def in_mode(self, name: str) -> bool:
        return self.state.mode == MODES[self.vehicle_type][name]

    def set_mode(self, name: str) -> None:
        self.link.ask_for_mode(MODES[self.vehicle_type][name])

    def arming(self) -> ProcedureStep | None:
        """Return the next step on the way to an armed vehicle: wait until the vehicle is ready, or arm it. Return None
        if the vehicle is armed.
        """
        if self.state.armed:
            return None
        return ARM if self.state.ready_to_arm and self.state.position else READY

    def arm(self) -> None:
        self.link.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def accepted(self, command: int) -> bool:
        return command in self.link.accepted

    def refused(self, commands: Sequence[int]) -> bool:
        """Return true if the vehicle answered one of these commands with MAV_RESULT_FAILED. Each answer is counted only
        once.
        """
        failed = [command for command in commands if self.link.acks.get(command) == int(mavlink.MAV_RESULT_FAILED)]
        for command in failed:
            del self.link.acks[command]
        return bool(failed)
