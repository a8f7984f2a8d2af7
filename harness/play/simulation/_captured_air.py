"""What vehicles would capture in virtual time: the air, with a tap at every vehicle's interface.

The same files as of real vehicles (`netem.capture`), of the frames that a kernel would make. Mission second 0 is the
Unix epoch, at speedup 1. Whoever is paused or dead still has an interface, which frames reach; a copy that the air
corrupts reaches nobody here.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from functools import lru_cache
from pathlib import Path
from typing import Any

from harness.play.simulation.air import Happening, InFlight, StrayDatagram, VirtualAir
from netem.capture import begin_file
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile
from ucp.messages import PORT, Message, encode
from ucp.trace import Recorded

NANOSECONDS = 1_000_000_000
FRAMES_KEPT = 4096


class VirtualCapture:
    """The files of `roster`, in `folder`. What writes raises OSError."""

    def __init__(self, folder: Path, roster: Sequence[int]) -> None:
        self._roster = roster
        with ExitStack() as opened:
            self._files = [
                opened.enter_context(closing(PcapngFile(begin_file(folder, vehicle, epoch_us=0, speedup=1))))
                for vehicle in roster
            ]
            self._open = opened.pop_all()

    def air(self, *arguments: Any, deliver_all: bool) -> "CapturedAir":
        """An air that is taken down."""
        return CapturedAir(self, *arguments, deliver_all=deliver_all)

    def take_down(self, mission_s: float, number: int, frame: bytes, *, outbound: bool) -> None:
        """The vehicle with this number sends the frame, or it reaches that vehicle."""
        self._files[number].packet(round(mission_s * NANOSECONDS), frame, outbound=outbound)

    def end(self, mission_s: float) -> dict[str, dict[str, int]]:
        """Finish the files; what is in them, as in run.json."""
        counted = {}
        with self._open:
            for vehicle, file in zip(self._roster, self._files, strict=True):
                counted[str(vehicle)] = {"received": file.packets, "dropped": 0}
                file.statistics(round(mission_s * NANOSECONDS), **counted[str(vehicle)])
        return counted


class CapturedAir(VirtualAir):
    """Delivers everything, also what cannot matter, and takes it down."""

    def __init__(self, capture: VirtualCapture, *arguments: Any, deliver_all: bool) -> None:
        super().__init__(*arguments, deliver_all=True)
        self._capture = capture

    def until(self, mission_s: float) -> Iterator[Happening]:
        for happening in super().until(mission_s):
            at, _, number, what = happening
            if isinstance(what, InFlight):
                frame = _frame(what.sender, what.sequence, what.message, what.sealed)
                self._capture.take_down(at, number, frame, outbound=False)
            elif isinstance(what, StrayDatagram):
                frame = udp_broadcast(what.source, PORT, what.datagram)
                self._capture.take_down(at, number, frame, outbound=False)
            yield happening

    def broadcast_stray(self, now: float, number: int, datagram: bytes) -> None:
        self._capture.take_down(now, number, udp_broadcast(self._roster[number], PORT, datagram), outbound=True)
        super().broadcast_stray(now, number, datagram)

    def broadcast(
        self,
        now: float,
        number: int,
        sequence: int,
        message: Message,
        data_bytes: int,
        datagram: Recorded | None = None,
        sealed: bytes | None = None,
    ) -> None:
        self._capture.take_down(now, number, _frame(self._roster[number], sequence, message, sealed), outbound=True)
        super().broadcast(now, number, sequence, message, data_bytes, datagram, sealed)


@lru_cache(FRAMES_KEPT)
def _frame(sender: int, sequence: int, message: Message, sealed: bytes | None) -> bytes:
    return udp_broadcast(sender, PORT, sealed or encode(sender, sequence, message))
