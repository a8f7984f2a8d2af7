"""One vehicle as a process in its own namespace, and the pilot that flies it."""

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

from harness.errors import HarnessError
from harness.rundir import RunDirectory
from netem.lab import Lab, LabProcess
from sitl.pilot import Pilot
from sitl.vehicle import MAX_SYSID, Home, Launch, VehicleError, VehicleKind

LISTEN_LIMIT_S = 20.0
CONNECT_LIMIT_S = 2.0
ASK_AGAIN_S = 0.05
STOP_GRACE_S = 3.0
LAST_WORDS = 3


class VehicleFailedError(HarnessError):
    """A vehicle could not be started or flown, or ended by itself."""


class VehicleProcess:
    """`index` counts the vehicles of a run from 0."""

    def __init__(self, vehicle_id: int, index: int, kind: VehicleKind, rundir: RunDirectory) -> None:
        self.vehicle_id = vehicle_id
        self.kind = kind
        # A vehicle is alone in its namespace: a system ID need not be unique, only possible.
        self.sysid = vehicle_id if vehicle_id <= MAX_SYSID else index % MAX_SYSID + 1
        self.pilot: Pilot | None = None
        self._directory = rundir.vehicle(vehicle_id)
        self._process: LabProcess | None = None

    @property
    def _output(self) -> Path:
        return self._directory / "output.log"

    async def start(self, lab: Lab, home: Home, speedup: float) -> None:
        """Start the vehicle and connect its pilot. Raises VehicleFailedError."""
        try:
            launch = self.kind.launch(self.sysid, home, speedup, self._directory)
        except VehicleError as error:
            raise VehicleFailedError(str(error)) from None
        self._process = await lab.spawn(
            self.vehicle_id,
            launch.argv,
            cwd=self._directory,
            env={**os.environ, **launch.env},
            stdout=self._output,
            stderr=self._output,
        )
        await self._connect(lab, launch, speedup)

    async def _connect(self, lab: Lab, launch: Launch, speedup: float) -> None:
        assert self._process is not None
        deadline = asyncio.get_running_loop().time() + LISTEN_LIMIT_S
        while True:
            try:
                sock = await lab.connect(self.vehicle_id, launch.pilot_port, timeout_s=CONNECT_LIMIT_S)
                break
            except (ConnectionError, TimeoutError):
                if self._process.returncode is not None:
                    raise self._ended(self._process.returncode) from None
                if asyncio.get_running_loop().time() > deadline:
                    raise VehicleFailedError(
                        f"vehicle {self.vehicle_id} ({self.kind.name}) does not listen on port {launch.pilot_port} "
                        f"after {LISTEN_LIMIT_S:g} s{self._last_words()}"
                    ) from None
                await asyncio.sleep(ASK_AGAIN_S)
        self.pilot = Pilot(self.sysid, sock, self._directory / "telemetry.tlog", speedup)
        await self.pilot.start()

    async def take_off(self, altitude_m: float) -> None:
        """Raises VehicleFailedError."""
        assert self.pilot is not None
        try:
            await self.pilot.take_off(altitude_m)
        except VehicleError as error:
            raise VehicleFailedError(str(error)) from None

    async def watch(self) -> None:
        """Raises VehicleFailedError when the process ends."""
        assert self._process is not None
        raise self._ended(await self._process.wait())

    async def stop(self) -> None:
        if self.pilot is not None:
            await self.pilot.close()
        if self._process is not None and self._process.returncode is None:
            await self._process.terminate(STOP_GRACE_S)

    def to_json(self) -> dict[str, Any]:
        record: dict[str, Any] = {"kind": self.kind.name, "sysid": self.sysid}
        if self.pilot is not None:
            state, factor = self.pilot.state, self.pilot.real_time_factor
            record["mode"] = state.mode
            record["armed"] = state.armed
            record["real_time_factor"] = None if factor is None else round(factor, 4)
            if state.position is not None:
                record["altitude_m"] = round(state.position.relative_alt_m, 1)
            if state.log_error is not None:
                record["telemetry_log_error"] = state.log_error
            if state.texts:
                record["last_text"] = state.texts[-1]
        return record

    def _ended(self, returncode: int) -> VehicleFailedError:
        how = signal.Signals(-returncode).name if returncode < 0 else f"status {returncode}"
        return VehicleFailedError(
            f"vehicle {self.vehicle_id} ({self.kind.name}) ended by itself with {how}{self._last_words()}"
        )

    def _last_words(self) -> str:
        try:
            lines = self._output.read_text(encoding="utf-8", errors="replace").splitlines()[-LAST_WORDS:]
        except OSError:
            lines = []
        said = " / ".join(line.strip() for line in lines if line.strip())
        where = f"vehicles/{self.vehicle_id}/{self._output.name}"
        return f"; its last words ({where}): {said}" if said else f"; it said nothing ({where})"
