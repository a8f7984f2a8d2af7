"""Write packet capture files of a simulated run, one for the network interface of each vehicle.

The files have the format of `netem.capture`, and contain the frames that a kernel would send. Mission second 0 is the
Unix epoch, at speedup 1. The files of a paused or dead agent also contain the frames that reach its interface. If a
receiver's copy of a frame is corrupted, the receiver's file lacks this frame, because the simulation does not deliver
corrupted copies.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.play.simulation.air import MessageInFlight, ScheduledInput, StrayDatagram, VirtualAir
from netem.capture import begin_file
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile
from ucp.messages import PORT, Message, encode
from ucp.trace import RecordedBytes

NANOSECONDS = 1_000_000_000
FRAMES_KEPT = 4096


class VirtualCapture:
    """The packet capture files of all vehicles. The files are in `folder`. Methods that write raise OSError."""

    def __init__(self, folder: Path, roster: Sequence[int]) -> None:
        self._roster = roster
        with ExitStack() as opened:
            self._files = [
                opened.enter_context(closing(PcapngFile(begin_file(folder, vehicle, epoch_us=0, speedup=1))))
                for vehicle in roster
            ]
            self._open = opened.pop_all()

    def air(self, *arguments: Any, deliver_all: bool) -> "CapturedAir":
        """Return a simulated network that writes all frames to these capture files."""
        return CapturedAir(self, *arguments, deliver_all=deliver_all)

    def record(self, mission_s: float, number: int, frame: bytes, *, outbound: bool) -> None:
        """Record a frame that this vehicle sends or receives."""
        self._files[number].packet(round(mission_s * NANOSECONDS), frame, outbound=outbound)

    def end(self, mission_s: float) -> dict[str, dict[str, int]]:
        """Finish the capture files, and return the number of frames in each file, for run.json."""
        counted = {}
        with self._open:
            for vehicle, file in zip(self._roster, self._files, strict=True):
                counted[str(vehicle)] = {"received": file.packets, "dropped": 0}
                file.statistics(round(mission_s * NANOSECONDS), **counted[str(vehicle)])
        return counted


class CapturedAir(VirtualAir):
    """A simulated network that delivers all messages and records them as packets."""

    def __init__(self, capture: VirtualCapture, *arguments: Any, deliver_all: bool) -> None:
        super().__init__(*arguments, deliver_all=True)
        self._capture = capture

    def inputs_until(self, mission_s: float) -> Iterator[ScheduledInput]:
        return self._recorded(super().inputs_until(mission_s))

    def _recorded(self, inputs: Iterator[ScheduledInput]) -> Iterator[ScheduledInput]:
        for scheduled in inputs:
            at, _, number, what = scheduled
            if isinstance(what, MessageInFlight):
                frame = _frame(what.sender, what.sequence, what.message, what.encoded)
                self._capture.record(at, number, frame, outbound=False)
            elif isinstance(what, StrayDatagram):
                frame = udp_broadcast(what.source, PORT, what.datagram)
                self._capture.record(at, number, frame, outbound=False)
            yield scheduled

    def broadcast_stray(self, now: float, number: int, datagram: bytes) -> None:
        self._capture.record(now, number, udp_broadcast(self._roster[number], PORT, datagram), outbound=True)
        super().broadcast_stray(now, number, datagram)

    def broadcast(
        self,
        now: float,
        number: int,
        sequence: int,
        message: Message,
        data_bytes: int,
        datagram: RecordedBytes | None = None,
        encoded: bytes | None = None,
    ) -> None:
        self._capture.record(now, number, _frame(self._roster[number], sequence, message, encoded), outbound=True)
        super().broadcast(now, number, sequence, message, data_bytes, datagram, encoded)


@lru_cache(FRAMES_KEPT)
def _frame(sender: int, sequence: int, message: Message, encoded: bytes | None) -> bytes:
    return udp_broadcast(sender, PORT, encoded or encode(sender, sequence, message))
