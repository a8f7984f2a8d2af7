"""Find packet capture files. Read all captures of one mission, and convert their times with a common clock."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from harness.archive.packets.capture_reader import Capture, Datagram
from harness.errors import CaptureError, RunDirectoryError

if TYPE_CHECKING:
    from ucp.secure.opening import DatagramOpener

DIRECTORY = "capture"
"""Name of the directory with captures in a run directory."""
SUFFIXES = (".pcapng", ".pcap")


class CaptureClock(NamedTuple):
    """A converter from capture times to mission seconds. `epoch_ns` is the capture time of mission second 0.

    `of_run` is false if no capture has a comment with the start of the run. In this case `epoch_ns` is the time of the
    first packet. The times of captures from the field differ by the errors of the vehicles' clocks.
    """

    epoch_ns: int
    speedup: float
    of_run: bool

    def seconds(self, time_ns: int) -> float:
        return (time_ns - self.epoch_ns) / 1e9 * self.speedup


class Captures(NamedTuple):
    """The packet captures of one mission. `errors` contains a sentence for each unusable file."""

    used: list[Capture]
    datagrams: list[Datagram]
    clock: CaptureClock
    errors: list[str]

    @property
    def problems(self) -> list[str]:
        """A sentence for each problem of a file that is used."""
        return [problem for capture in self.used for problem in capture.problems]


def capture_files(paths: Iterable[Path]) -> list[Path]:
    """Return the capture files at `paths`. A path is a capture file, a run directory, or another directory with
    captures. The result contains each file once.

    Raises RunDirectoryError if a path does not exist, or a directory contains no capture.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inner = path / DIRECTORY
            captures = [file for file in (inner if inner.is_dir() else path).iterdir() if file.suffix in SUFFIXES]
            if not captures:
                raise RunDirectoryError(f"{path}: holds no captures (*.pcapng): `ucp-harness run --capture` makes them")
            files += sorted(captures, key=lambda file: (len(file.name), file.name))
        elif path.exists():
            files.append(path)
        else:
            raise RunDirectoryError(f"{path}: does not exist; give a run directory or captures (*.pcapng, *.pcap)")
    return list({file.resolve(): file for file in files}.values())


def read_captures(paths: Iterable[Path], opener: "DatagramOpener | None" = None) -> Captures:
    """Read all captures of one mission. The first capture with a comment determines the mission.

    Captures from the field have no comment and are always used. `opener` decrypts the datagrams of a secured mission.
    """
    used: list[Capture] = []
    errors: list[str] = []
    datagrams: dict[bytes, Datagram] = {}
    clock: CaptureClock | None = None
    for number, path in enumerate(paths):
        capture = Capture(number, path)
        try:
            capture.read(datagrams, opener=opener)
        except CaptureError as error:
            errors.append(str(error))
            continue
        if capture.comment is not None:
            own = CaptureClock(capture.comment.epoch_us * 1000, capture.comment.speedup, True)
            if clock not in (None, own):
                errors.append(f"{path}: of another run than the captures before it; print each run separately")
                continue
            clock = own
        used.append(capture)
    whose = {capture.vehicle for capture in used if capture.comment}
    for capture in used:
        if not capture.comment and capture.vehicle in whose:
            capture.vehicle = None  # Its name or content suggests a vehicle that already has a capture of its own.
    first_ns = min((capture.began_ns for capture in used if capture.began_ns is not None), default=0)
    return Captures(used, list(datagrams.values()), clock or CaptureClock(first_ns, 1.0, False), errors)
