"""The capture of a lab as the orchestrator sees it: a pcapng file for each vehicle, of all that its interface saw.

    capture = await LiveCapture.start(lab, folder)
    await capture.begin(epoch_us, speedup)
    counted = await capture.stop()

In FOLDER/7.pcapng is every Ethernet frame that vehicle 7 put on the air (outbound), and every one that reached its
interface (inbound), whether or not anybody was there to receive it. Frames that netem or nftables dropped on the way
are in their sender's file alone; those that netem corrupted are as they came. The comment of the section header is a
JSON object, which says when a packet was: mission_s = (timestamp - epoch) * speedup.
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
_LOOK_AGAIN_S = 0.01
_STOP_S = 20.0


def begin_file(folder: Path, vehicle: int, epoch_us: int, speedup: float) -> Path:
    """Begin a vehicle's capture; mission second 0 is at `epoch_us`, microseconds since the Unix epoch. Raises OSError.

    `pcapng.PcapngFile` goes on with it.
    """
    comment = json.dumps({"ucp_harness": 1, "vehicle": vehicle, "epoch_us": epoch_us, "speedup": float(speedup)})
    path = folder / f"{vehicle}.pcapng"
    path.write_bytes(pcapng.header(f"vehicle {vehicle}", comment))
    return path


class LiveCapture:
    """Made by `LiveCapture.start` only."""

    def __init__(self, vehicles: Sequence[int], folder: Path, process: LabProcess) -> None:
        self._vehicles = vehicles
        self._folder = folder
        self._process = process
        self.processor_s = 0.0
        """Processor time that it has cost, once it is stopped."""

    @classmethod
    async def start(cls, lab: Lab, folder: Path, vehicles: Sequence[int] | None = None) -> LiveCapture:
        """Tap the ports of `vehicles`, or of all in the lab; raises LiveCaptureError.

        What crosses them from now on waits in memory.
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
                    await asyncio.sleep(_LOOK_AGAIN_S)
        except TimeoutError:
            raise LiveCaptureError(f"The capture was not ready within {_READY_S:g} s; see {log}") from None
        return capture

    async def begin(self, epoch_us: int, speedup: float) -> None:
        """Begin the files, with what has waited. Raises OSError if they cannot be made."""
        for vehicle in self._vehicles:
            begin_file(self._folder, vehicle, epoch_us, speedup)
        await self._process.send_signal(signal.SIGUSR1)

    async def watch(self) -> None:
        """Raises LiveCaptureError when it ends by itself."""
        raise self._ended(await self._process.wait())

    async def stop(self) -> dict[int, dict[str, int]]:
        """Finish the files; of each vehicle how many frames were `received`, and how many of them `dropped`.

        Those that were dropped are in no file. Raises LiveCaptureError if the capture failed, now or before.
        """
        returncode = await self._process.terminate(_STOP_S)
        if returncode != 0:
            raise self._ended(returncode)
        report: dict[str, Any] = json.loads(self._last_word())
        self.processor_s = report["processor_s"]
        return {int(vehicle): counted for vehicle, counted in report["vehicles"].items()}

    def _ended(self, returncode: int) -> LiveCaptureError:
        how = in_words(returncode) if returncode < 0 else self._last_word()
        return LiveCaptureError(f"The capture of packets failed: {how}")

    def _last_word(self) -> str:
        lines = _log(self._folder).read_text(errors="replace").splitlines()
        return lines[-1] if lines else "it said nothing"


def _log(folder: Path) -> Path:
    return folder / "capture.log"
