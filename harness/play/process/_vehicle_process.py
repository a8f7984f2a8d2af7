"""Run one vehicle: a program in its own network namespace, and the pilot that flies it."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from harness.archive.directory import RunDirectory
from harness.errors import HarnessError
from harness.play._child_processes import passed_on
from harness.play.process._run_lab import VehicleLab
from harness.play.process.lab_program import LabProgram
from harness.scenario.vehicles import Flight
from netem.radio import Place
from sitl.circumstances import SimulatedFailure
from sitl.ground_station import GroundStation
from sitl.modes import mav_type
from sitl.parameters import in_lines
from sitl.pilot import Pilot
from sitl.procedure import PilotProcedure
from sitl.vehicle import STATION_PORT, Home, Launch, VehicleError, VehicleKind

LISTEN_LIMIT_S = 20.0
CONNECT_LIMIT_S = 2.0
RETRY_S = 0.05
STOP_GRACE_S = 3.0
END_LIMIT_S = 0.5
LAST_LINES = 3
PARAMETERS = "parameters.parm"


class VehicleFailedError(HarnessError):
    """An error: a vehicle could not be started or flown, or its program ended without a request."""


class VehicleProcess:
    """The program of one vehicle. `sysid` is the MAVLink system ID of the vehicle. `incarnation` is 1 for the first
    program of the vehicle, 2 for its first replacement, and so on. `lost_worker` returns None while the computer that
    runs the program is connected. After the loss of the connection, it returns the address of this computer.
    """

    def __init__(
        self,
        vehicle_id: int,
        sysid: int,
        kind: VehicleKind,
        rundir: RunDirectory,
        incarnation: int = 1,
        lost_worker: Callable[[], str | None] = lambda: None,
    ) -> None:
        self.vehicle_id = vehicle_id
        self.sysid = sysid
        self.kind = kind
        self._abandoned = self._introduced = False
        self.pilot: Pilot | None = None
        self._directory = rundir.vehicle(vehicle_id, incarnation)
        self._process: LabProgram | None = None
        self._flight: PilotProcedure | None = None
        self._circumstances: list[dict[str, Any]] = []
        self._station_port = STATION_PORT
        self._lost_worker = lost_worker
        self._lost_with: str | None = None
        """The address of the worker (a computer of a cluster) that ran the vehicle, if the worker was lost. Otherwise
        None.
        """

    @property
    def _output(self) -> Path:
        return self._directory / "output.log"

    async def start(self, lab: VehicleLab, home: Home, speedup: float) -> None:
        """Start the vehicle and connect its pilot. Raises VehicleFailedError."""
        self._home = home
        try:
            launch = self.kind.launch(self.sysid, home, speedup, self._directory)
        except VehicleError as error:
            raise VehicleFailedError(str(error)) from None
        self._process = await lab.spawn(
            self.vehicle_id,
            launch.argv,
            cwd=self._directory,
            env={**passed_on(os.environ), **launch.env},
            stdout=self._output,
            stderr=self._output,
            role="vehicle",
        )
        await self._connect(lab, launch, speedup)

    async def _connect(self, lab: VehicleLab, launch: Launch, speedup: float) -> None:
        assert self._process is not None
        self._station_port = launch.station_port
        deadline = asyncio.get_running_loop().time() + LISTEN_LIMIT_S
        while True:
            try:
                sock = await lab.connect(self.vehicle_id, launch.pilot_port, timeout_s=CONNECT_LIMIT_S)
                break
            except (ConnectionError, TimeoutError):
                if self._process.returncode is not None:
                    raise self._end_error(self._process) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise VehicleFailedError(
                        f"vehicle {self.vehicle_id} ({self.kind.name}) does not listen on port {launch.pilot_port} "
                        f"after {LISTEN_LIMIT_S:g} s{self._last_output()}"
                    ) from None
                await asyncio.sleep(RETRY_S)
        tlog = self._directory / "telemetry.tlog"
        self.pilot = Pilot(self.sysid, sock, tlog, speedup, self._home, self.kind.vehicle_type, self.vehicle_id)
        await self.pilot.start()

    async def join(self, station: GroundStation, lab: VehicleLab) -> None:
        """Connect the vehicle with the ground station. Raises VehicleFailedError."""
        try:
            sock = await lab.connect(self.vehicle_id, self._station_port, timeout_s=CONNECT_LIMIT_S)
        except (ConnectionError, TimeoutError):
            raise VehicleFailedError(
                f"vehicle {self.vehicle_id} ({self.kind.name}) does not listen on port {self._station_port} for a "
                "ground station: leave out --gcs"
            ) from None
        await station.attach(self.vehicle_id, self.sysid, sock)
        assert self.pilot is not None
        self.pilot.link.plays_station = False

    def hand_over(self) -> None:
        """Stop the automatic flight, so that an operator with a ground station can fly the vehicle."""
        assert self.pilot is not None
        self.pilot.hand_over()

    def place(self, field: Home) -> Place:
        """Return the last reported position relative to the middle of the field. If the vehicle has not reported a
        position, return its home position.
        """
        position = self.pilot.state.position if self.pilot else None
        if position is None:
            return Place(*field.metres_to(self._home.lat_deg, self._home.lon_deg, self._home.alt_m))
        return Place(*field.metres_to(position.lat_deg, position.lon_deg, position.alt_m))

    def prepare(self, flight: Flight | None, altitude_m: float) -> None:
        """Set the flight that the vehicle performs later. If `flight` is None, the vehicle only climbs to `altitude_m`
        metres.
        """
        assert self.pilot is not None
        self._flight = self.pilot.flight(flight.to_plan(), flight.by) if flight else self.pilot.ascent(altitude_m)

    async def _introduce(self) -> None:
        """Set the requested parameters, and record the version and all parameters of the vehicle. Later calls have no
        effect.

        Raises VehicleFailedError after a kill.
        """
        assert self.pilot is not None
        if self._introduced:
            return
        self._introduced = True
        await self._run_pilot(self.pilot.introduce(self.kind.parameters))
        known = self.pilot.link.parameters
        if known:
            (self._directory / PARAMETERS).write_text(in_lines(known), encoding="utf-8")

    async def get_ready(self) -> None:
        """Prepare the vehicle until it can be armed. Raises VehicleFailedError if this fails. The process of the
        vehicle has then ended.
        """
        assert self.pilot is not None and self._flight is not None
        await self._introduce()
        await self._run_pilot(self.pilot.get_ready(self._flight))

    async def fly(self) -> None:
        """Fly the vehicle, and then read its telemetry until the mission ends. Raises VehicleFailedError if the flight
        fails. The process of the vehicle has then ended.
        """
        assert self.pilot is not None and self._flight is not None
        await self._introduce()
        await self._run_pilot(self.pilot.fly(self._flight))
        await self._run_pilot(self.pilot.stay_in_touch())

    async def _run_pilot(self, flight: Coroutine[Any, Any, None]) -> None:
        """Run an operation of the pilot. If it fails, kill the vehicle and raise VehicleFailedError. If the vehicle was
        lost with its worker, return.
        """
        try:
            await flight
        except VehicleError as error:
            assert self._process is not None
            with contextlib.suppress(TimeoutError):  # a process ends shortly after its connection
                await asyncio.wait_for(self._process.wait(), END_LIMIT_S)
            if self._is_lost():
                return
            if self._process.returncode is not None:
                raise self._end_error(self._process) from None
            self._abandoned = True
            await self._process.send_signal(signal.SIGKILL)  # it may be in an endless loop, or fly away
            raise VehicleFailedError("; ".join(filter(None, (str(error), self.kind.lack)))) from None

    async def watch(self) -> None:
        """Wait for the process to end. Raises VehicleFailedError if it ended without a request."""
        assert self._process is not None
        await self._process.wait()
        if not self._abandoned and not self._is_lost():
            raise self._end_error(self._process)

    def _is_lost(self) -> bool:
        """Return true if the vehicle was lost with its worker. Such a vehicle is not at fault, and the run goes on."""
        self._lost_with = self._lost_with or self._lost_worker()
        return self._lost_with is not None

    async def kill(self) -> None:
        """Kill the process with SIGKILL. Before the call, cancel the tasks that run `watch` and `fly`."""
        assert self._process is not None
        await self._process.send_signal(signal.SIGKILL)
        await self._process.wait()
        if self.pilot is not None:
            await self.pilot.close()

    async def fall(self) -> None:
        """Stop the motors, end the flight, and let the vehicle fall to the ground. Raises VehicleFailedError."""
        assert self.pilot is not None
        await self._run_pilot(self.pilot.terminate_flight())

    def shortfall(self) -> str | None:
        """Return a sentence if the vehicle is still active but has not left its home position. Otherwise return
        None.
        """
        if self.pilot is None or self._flight is None or self._process is None or self._process.returncode is not None:
            return None
        if self._is_lost():
            return None
        return self.pilot.shortfall(self._flight)

    async def simulate(self, what: str, circumstance: SimulatedFailure, at_s: float) -> str | None:
        """Make the vehicle simulate an event such as a GPS failure. If the vehicle cannot do this, return a sentence
        with the reason.
        """
        assert self.pilot is not None
        entry: dict[str, Any] = {"at_s": at_s, "what": what, "parameters": {}}
        self._circumstances.append(entry)
        try:
            entry["parameters"] = dict(await self.pilot.befall(circumstance))
        except VehicleError as error:
            return (
                f"{what} at {at_s:g} s: vehicle {self.vehicle_id} ({self.kind.name} {self.kind.vehicle_type}) {error}"
            )
        return None

    async def stop(self) -> None:
        if self.pilot is not None:
            await self.pilot.close()
        if self._process is not None and self._process.returncode is None:
            await self._process.terminate(STOP_GRACE_S)

    def to_json(self) -> dict[str, object]:
        record: dict[str, Any] = {"kind": self.kind.name, "type": self.kind.vehicle_type, "sysid": self.sysid}
        record |= self._firmware()
        if self._lost_with is not None:
            record["lost_with"] = self._lost_with
        if self.pilot is not None:
            state, factor = self.pilot.state, self.pilot.real_time_factor
            record["mode"] = state.mode
            record["armed"] = state.armed
            record["real_time_factor"] = None if factor is None else round(factor, 4)
            if state.position is not None:
                record["altitude_m"] = round(state.position.relative_alt_m, 1)
            if state.garbage:
                record["garbage"] = state.garbage
            if state.log_error is not None:
                record["telemetry_log_error"] = state.log_error
            if self._circumstances:
                record["befallen"] = self._circumstances
            if state.texts:
                record["last_text"] = state.texts[-1]
        return record

    def _firmware(self) -> dict[str, object]:
        """Return the version, type and parameters that the vehicle reported. File names are relative to the run
        directory.
        """
        given: dict[str, Any] = {"frame": self.kind.frame, "binary_sha256": self.kind.sha256}
        if self.pilot is not None:
            state, parameters = self.pilot.state, self.pilot.link.parameters
            if state.mav_type is not None:
                given["mav_type"] = mav_type(state.mav_type)
            if state.version is not None:
                given |= {"version": state.version.number, "commit": state.version.commit}
            if (self._directory / PARAMETERS).exists():
                file = f"vehicles/{self._directory.name}/{PARAMETERS}"
                given |= {"parameters": len(parameters), "parameters_file": file}
        if self.kind.parameters:
            given["parameters_given"] = dict(self.kind.parameters)
        return {key: value for key, value in given.items() if value is not None}

    def _end_error(self, process: LabProgram) -> VehicleFailedError:
        return VehicleFailedError(
            f"vehicle {self.vehicle_id} ({self.kind.name}) ended by itself with {process.end}{self._last_output()}"
        )

    def _last_output(self) -> str:
        try:
            lines = self._output.read_text(encoding="utf-8", errors="replace").splitlines()[-LAST_LINES:]
        except OSError:
            lines = []
        words = " / ".join(line.strip() for line in lines if line.strip())
        where = f"vehicles/{self._directory.name}/{self._output.name}"
        return f"; its last output ({where}): {words}" if words else f"; it printed nothing ({where})"
