"""Fly ArduPilot or the embedded vehicle over MAVLink.

A pilot has a link (_pilot_link.py) and executes procedures (procedure.py): a take-off, a plan as a mission or in GUIDED
mode, and the end of a flight. The steps before arming are executed separately. Each step has a time limit, and the
vehicle must not be silent for too long. If a limit expires, or the vehicle ends the connection, the pilot raises a
FlightError. The error names the step and the last message of the vehicle.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from sitl._by_guided import GuidedFlight
from sitl._by_mission import MissionFlight
from sitl._introduction import VehicleIntroduction
from sitl._pilot_link import PilotLink
from sitl._route import route
from sitl._take_off import FlightTermination, TakeOff
from sitl._vehicle_state import VehicleState
from sitl.circumstances import SimulatedFailure, bring_about
from sitl.modes import mode_name
from sitl.parameters import ParameterError, unknown
from sitl.plan import By, Plan
from sitl.procedure import ArmingPreparation, HopelessError, PilotProcedure, ProcedureStep
from sitl.vehicle import FlightError, Home, VehicleType

SILENCE_S = 10.0  # wall time; a vehicle sends messages every simulated second
LEAST_WAIT_S = 3.0  # wall time: minimum time for each step at any speedup, because the machine may be busy
ASK_AGAIN_S = 2.0  # wall time without a position after which telemetry is requested again


class Pilot:
    """The pilot of one vehicle, which sends it MAVLink commands. Use it in one event loop only."""

    def __init__(
        self,
        sysid: int,
        sock: socket.socket,
        tlog: Path,
        speedup: float,
        home: Home,
        vehicle_type: VehicleType = "copter",
        vehicle_id: int | None = None,
    ) -> None:
        """Create the pilot. `sock` must be connected to the pilot port of the vehicle. `close` closes the socket.

        `sysid` is the MAVLink system ID. `tlog` is the file of the telemetry log. `speedup` (simulated seconds per
        second) and `home` are the values with which the vehicle was started. Error messages contain `vehicle_id`, which
        is the system ID by default. Raises OSError if `tlog` cannot be opened.
        """
        self.link = PilotLink(sysid, sock, tlog, speedup, home)
        self.vehicle_type: VehicleType = vehicle_type
        self.vehicle_id = sysid if vehicle_id is None else vehicle_id
        self._terminated = self._handed_over = False
        self._befallen = False
        self._awaited: ProcedureStep | None = None

    @property
    def state(self) -> VehicleState:
        return self.link.state

    @property
    def real_time_factor(self) -> float | None:
        """The number of simulated seconds per second of wall time, divided by the speedup. The value is 1.0 if the
        machine is fast enough, and less if it is too slow.
        """
        return self.link.real_time_factor

    async def start(self) -> None:
        """Start to read and log messages, and to send heartbeats."""
        await self.link.start()

    async def close(self) -> None:
        """End the connection and complete the telemetry log. It may be called twice, and before `start`."""
        await self.link.close()

    def ascent(self, altitude_m: float) -> PilotProcedure:
        """Return the procedure for a take-off to `altitude_m` metres above home. A rover only arms, in GUIDED mode."""
        return TakeOff(self.link, self.vehicle_type, altitude_m)

    def flight(self, plan: Plan, by: By) -> PilotProcedure:
        """Return the procedure for a flight plan. Raises PlanError if this type of vehicle cannot fly it."""
        waypoints = route(plan, self.vehicle_type, self.link.home.heading_deg)
        flight = MissionFlight if by == "mission" else GuidedFlight
        return flight(self.link, self.vehicle_type, waypoints)

    async def introduce(self, given: Mapping[str, float]) -> None:
        """Request the version and the parameters of the vehicle, and set the parameters in `given`.

        Raises FlightError, and ParameterError if the vehicle does not know some of the given parameters.
        """
        await self._pursue(VehicleIntroduction(self.link, given))
        if phrase := unknown(given, self.link.parameters):
            raise ParameterError(f"vehicle {self.vehicle_id} knows {phrase}")

    async def get_ready(self, flight: PilotProcedure) -> None:
        """Execute the steps before arming. Return when all steps have stayed complete for READY_FOR_S seconds.

        One report that the vehicle is ready is not enough. ArduPilot repeats its checks, and has further checks in
        other modes, so it may later report that it is not ready. Raises FlightError.
        """
        await self._pursue(ArmingPreparation(flight, self.state))

    async def fly(self, flight: PilotProcedure) -> None:
        """Execute the procedure until its last step is complete. Raises FlightError."""
        await self._pursue(flight)

    async def terminate_flight(self) -> None:
        """Force the vehicle to disarm in flight, and return when it lies on the ground. Raises FlightError.

        The current procedure ends without an error.
        """
        self._terminated = True
        await self._pursue(FlightTermination(self.link))

    async def befall(self, circumstance: SimulatedFailure) -> Mapping[str, float]:
        """Make the vehicle simulate an event such as a GPS failure. Return the parameters that were set.

        From now on, the vehicle may act on its own. If it then leaves its mode, disarms, or misses a time limit, the
        current procedure ends without an error. Raises NotSimulatedError if the vehicle cannot simulate the event.
        """
        had_befallen, self._befallen = self._befallen, True  # the vehicle may act before it confirms a parameter
        try:
            values = await bring_about(self.link, circumstance)
        except BaseException:
            self._befallen = had_befallen
            raise
        if circumstance.station_is_heard is not None:
            self.link.station_is_heard = circumstance.station_is_heard
        return values

    def shortfall(self, flight: PilotProcedure) -> str | None:
        """If the vehicle should have left its home position but is still at home, return an error sentence. Otherwise
        return None.
        """
        if self.state.has_moved or self._terminated or self._handed_over or self._befallen:
            return None
        awaited = self._awaited.name if self._awaited else "its end"
        return str(self._failed(flight, awaited, "it has not left its home at the end of the mission"))

    def hand_over(self) -> None:
        """Let another pilot fly the vehicle. The current procedure ends without an error."""
        self._handed_over = True

    async def stay_in_touch(self) -> None:
        """Wait, and raise FlightError when the vehicle is silent or disconnects. Return after `terminate_flight`."""
        await self._pursue(_ListenOnlyProcedure())

    async def _pursue(self, procedure: PilotProcedure) -> None:
        """Request the first incomplete step of the procedure at each heartbeat, until all steps are complete."""
        clocks = _StepWaitingTimes(self.link)
        asked: tuple[ProcedureStep, int] | None = None
        while (step := self._next_step(procedure)) is not None:
            self._awaited = step
            if self._is_over(procedure):
                return
            if problem := clocks.lost():
                raise self._failed(procedure, step.name, problem)
            if problem := clocks.overdue(step):
                if self._befallen:
                    return
                raise self._failed(procedure, step.name, problem)
            if asked != (step, self.link.heartbeats):
                if asked is None or self._telemetry_is_missing():
                    self.link.request_telemetry()
                asked = (step, self.link.heartbeats)
                procedure.ask(step)
            self.link.heard.clear()
            try:
                async with asyncio.timeout(clocks.patience_s):
                    await self.link.heard.wait()
            except TimeoutError:
                continue

    def _is_over(self, procedure: PilotProcedure) -> bool:
        """Return true if the procedure need not continue. This is so if the flight was ended, if another pilot flies
        the vehicle, or if the vehicle has left its mode because of a simulated failure.
        """
        if isinstance(procedure, FlightTermination):
            return False
        left = self.link.has_left_its_mode or self.link.has_disarmed
        handed_over = self._handed_over or (self._befallen and left)
        return self._terminated or (handed_over and not isinstance(procedure, _ListenOnlyProcedure))

    def _next_step(self, procedure: PilotProcedure) -> ProcedureStep | None:
        try:
            return procedure.next_step()
        except HopelessError as error:
            if self._befallen or self._is_over(procedure):
                return None
            raise self._failed(procedure, "the next leg", str(error)) from None

    def _telemetry_is_missing(self) -> bool:
        link = self.link
        stale = link.position_at is None or time.monotonic() - link.position_at > ASK_AGAIN_S
        boots = not link.state.ready_to_arm and not link.has_armed  # it may acknowledge a request and then forget it
        return stale or boots

    def _failed(self, procedure: PilotProcedure, awaited: str, reason: str) -> FlightError:
        state = self.state
        words = f"its last text is {state.texts[-1]!r}" if state.texts else "it sent no text"
        return FlightError(
            f"vehicle {self.vehicle_id} did not {procedure.purpose}: waiting for {awaited}, {reason}; {words} (it is "
            f"{'armed' if state.armed else 'not armed'}, in mode {mode_name(self.vehicle_type, state.mode)}; "
            f"all it sent is in {self.link.tlog_path})"
        )


class _ListenOnlyProcedure:
    """A procedure without steps, during which the pilot only receives messages."""

    purpose = "stay in touch"
    _step = ProcedureStep("its next message", math.inf)

    def next_step(self) -> ProcedureStep:
        return self._step

    def ask(self, step: ProcedureStep) -> None:
        pass


class _StepWaitingTimes:
    """A record of how long the pilot has waited for each step, in simulated seconds and in seconds of wall time."""

    def __init__(self, link: PilotLink) -> None:
        self._link = link
        self._flown_s: defaultdict[ProcedureStep, float] = defaultdict(float)
        self._waited_s: defaultdict[ProcedureStep, float] = defaultdict(float)
        self._step: ProcedureStep | None = None  # the step for which the pilot waited until now
        self._time_s = link.state.time_s
        self._at = time.monotonic()
        self.patience_s = 0.0  # wall time until the next time limit may pass

    def lost(self) -> str | None:
        """Return the reason why the vehicle counts as lost. Return None if it does not count as lost."""
        now = time.monotonic()
        if self._link.closed.is_set():
            return "it ended the connection"
        if self._link.foreign_sysid is not None:
            return f"it sends the system ID {self._link.foreign_sysid}"
        for what, at in self._streams().items():
            if now - at >= self._silence_limit_s:
                return f"{what} for {now - at:.1f} s"
        return None

    def overdue(self, step: ProcedureStep) -> str | None:
        """Return a text about the time limit that the step has exceeded. Return None if the step has exceeded no time
        limit.
        """
        link, now = self._link, time.monotonic()
        if self._step is not None:
            if self._time_s is not None and link.state.time_s is not None:
                self._flown_s[self._step] += max(0.0, link.state.time_s - self._time_s)
            self._waited_s[self._step] += now - self._at
        self._step, self._time_s, self._at = step, link.state.time_s, now
        # a very slow simulation must fail, too: a step may not take longer than in real time
        wall_limit_s = max(step.limit_s, step.limit_s / link.speedup)
        silent_s = now - min(self._streams().values())
        self.patience_s = min(wall_limit_s - self._waited_s[step], self._silence_limit_s - silent_s)
        if self._flown_s[step] >= step.limit_s and self._waited_s[step] >= LEAST_WAIT_S:
            return f"{step.limit_s:g} simulated seconds were not enough"
        if self._waited_s[step] >= wall_limit_s:
            return f"after {self._waited_s[step]:.0f} s it has flown {self._flown_s[step]:.0f} simulated seconds"
        return None

    @property
    def _silence_limit_s(self) -> float:
        return SILENCE_S / min(1.0, self._link.speedup)

    def _streams(self) -> dict[str, float]:
        """Return the time of the last message of each kind: any message, a heartbeat, or a position. Each key is a
        phrase that reports silence, such as "it has sent no heartbeat". Heartbeats and positions are omitted until the
        vehicle has sent one.
        """
        times = {"it has sent no heartbeat": self._link.heartbeat_at, "it has sent no position": self._link.position_at}
        return {"it has been silent": self._link.heard_at, **{what: at for what, at in times.items() if at is not None}}
