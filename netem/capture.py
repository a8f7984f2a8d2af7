"""Capture all frames of a virtual network, in a pcapng file for each vehicle.

    capture = await LiveCapture.start(lab, folder)
    await capture.begin(epoch_us, speedup)
    counted = await capture.stop()

FOLDER/7.pcapng contains each Ethernet frame that vehicle 7 sent (outbound), and each one that reached its interface
(inbound), even if no program received it. Frames that netem or nftables dropped are only in their sender's file.
Corrupted frames are stored as they arrived. The comment of a file's section header is a JSON object. A reader uses its
keys `epoch_us` and `speedup` to convert a timestamp to mission seconds: (timestamp - epoch) * speedup.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from netem import pcapng
from netem.errors import LiveCaptureError
from netem.lab import Lab, LabProcess, in_words

_READY_S = 20.0
_POLL_S = 0.01
_STOP_S = 20.0


def begin_file(folder: Path, vehicle: int, epoch_us: int, speedup: float) -> Path:
    """Create a vehicle's capture file. Mission second 0 is `epoch_us`, in microseconds since the Unix epoch. Raises
    OSError.

    `pcapng.PcapngFile` appends to the file.
    """
    comment = json.dumps({"ucp_harness": 1, "vehicle": vehicle, "epoch_us": epoch_us, "speedup": float(speedup)})
    path = folder / f"{vehicle}.pcapng"
    path.write_bytes(pcapng.header(f"vehicle {vehicle}", comment))
    return path


class LiveCapture:
    """A running packet capture. `LiveCapture.start` creates it."""

    def __init__(self, vehicles: Sequence[int], folder: Path, process: LabProcess) -> None:
        self._vehicles = vehicles
        self._folder = folder
        self._process = process
        self.processor_s = 0.0
        """Processor time in seconds that the capture process used. The value is set by `stop`."""

    @classmethod
    async def start(cls, lab: Lab, folder: Path, vehicles: Sequence[int] | None = None) -> LiveCapture:
        """Start to capture frames at the switch ports of `vehicles`. Without `vehicles`, capture at the ports of all
        vehicles. Raises LiveCaptureError.

        Frames wait in memory until `begin`.
        """
        log, tapped = _log(folder), tuple(vehicles or lab.vehicles)
        process = await lab.spawn(
            None,
            [sys.executable, "-P", "-m", "netem.tap", str(folder), *map(str, tapped)],
            cwd=folder,
            env=dict(os.environ),
            stdout=log,
            stderr=log,
        )
        capture = cls(tapped, folder, process)
        try:
            async with asyncio.timeout(_READY_S):
                while "ready" not in log.read_text():
                    if process.returncode is not None:
                        raise capture._ended(process.returncode)
                    await asyncio.sleep(_POLL_S)
        except TimeoutError:
            raise LiveCaptureError(f"The capture was not ready within {_READY_S:g} s; see {log}") from None
        return capture

    async def begin(self, epoch_us: int, speedup: float) -> None:
        """Create the capture files, and write the frames that were captured before. Raises OSError."""
        for vehicle in self._vehicles:
            begin_file(self._folder, vehicle, epoch_us, speedup)
        await self._process.send_signal(signal.SIGUSR1)

    async def watch(self) -> None:
        """Wait until the capture ends unexpectedly, then raise LiveCaptureError."""
        raise self._ended(await self._process.wait())

    async def stop(self) -> dict[int, dict[str, int]]:
        """Finish the capture files. Return for each vehicle the number of frames, and the number of frames that are
        missing in its file. Raises LiveCaptureError if the capture failed.
        """
        returncode = await self._process.terminate(_STOP_S)
        if returncode != 0:
            raise self._ended(returncode)
        report: dict[str, Any] = json.loads(self._last_line())
        self.processor_s = report["processor_s"]
        return {int(vehicle): counted for vehicle, counted in report["vehicles"].items()}

    def _ended(self, returncode: int) -> LiveCaptureError:
        how = in_words(returncode) if returncode < 0 else self._last_line()
        return LiveCaptureError(f"The capture of packets failed: {how}")

    def _last_line(self) -> str:
        lines = _log(self._folder).read_text(errors="replace").splitlines()
        return lines[-1] if lines else "it printed nothing"


def _log(folder: Path) -> Path:
    return folder / "capture.log"
