"""What a capture is of: whose, and of which mission. Its first datagrams say so; the rest is only counted through."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.packets.capture_reader import Capture, Datagram
from harness.field.ingest.ingest import LeftOut

if TYPE_CHECKING:
    from ucp.secure.opening import Opener

ENOUGH_FRAMES = 5000


@dataclass(frozen=True)
class Glance:
    """`hashes` are of blocks and chains that its datagrams name, in hex."""

    path: Path
    vehicle: int | None
    epoch_us: int | None
    hashes: frozenset[str]
    source: Path
    """The file that it is, or was made from."""


def glance(path: Path, left_out: list[LeftOut], opener: "Opener | None" = None) -> Glance | None:
    """None if there is no UCP datagram at its beginning; `opener` opens what is sealed.

    Raises CaptureError if it cannot be read.
    """
    capture, datagrams = Capture(0, path), dict[bytes, Datagram]()
    capture.read(datagrams, ENOUGH_FRAMES, opener=opener)
    left_out += [LeftOut(path, problem.removeprefix(f"{path}: ")) for problem in capture.problems]
    if not datagrams:
        what = "no frame" if not capture.frames else f"none of its first {capture.frames} frames is of UCP"
        left_out.append(LeftOut(path, f"a capture, but there is {what} in it" if not capture.frames else what))
        return None
    named = (name for each in datagrams.values() for name in (each.summary.block_hash, each.summary.chain_hash))
    hashes = frozenset(name.hex() for name in named if name is not None)
    return Glance(path, capture.vehicle, capture.about.epoch_us if capture.about else None, hashes, path)
