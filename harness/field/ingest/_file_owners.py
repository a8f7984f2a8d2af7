"""Find the files to read, and the flights of files that do not name their flight.

The files to read are the files that the user gave, and the files in the given directories, each once. FIFOs, devices
and loops of links are omitted. Packet captures, public keys and mission files do not name their flight.
"""

import base64
import filecmp
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import BEFORE_FINAL_RECONCILE, RUN_FILE, ExportedBlock
from harness.archive.packets.capture_reader import Capture, Datagram
from harness.errors import FieldError
from harness.field.ingest._ingest import Flight, UnusedPart
from ucp.block import Block
from ucp.mission import Mission, MissionError, load_mission

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.opening import DatagramOpener


MAX_FRAMES_READ = 5000


@dataclass(frozen=True)
class CaptureSummary:
    """The facts about a packet capture that are needed to find its flight.

    `hashes` are the block and chain hashes in its datagrams, in hexadecimal.
    """

    path: Path
    vehicle: int | None
    epoch_us: int | None
    hashes: frozenset[str]
    source: Path
    """The original file of the capture. If an import created the capture, this file differs from `path`."""


def summarise_capture(
    path: Path, left_out: list[UnusedPart], opener: "DatagramOpener | None" = None
) -> CaptureSummary | None:
    """Read the beginning of a capture. Return None if it contains no UCP datagram. `opener` decrypts secured datagrams.

    Raises CaptureError if the file cannot be read.
    """
    capture, datagrams = Capture(0, path), dict[bytes, Datagram]()
    capture.read(datagrams, MAX_FRAMES_READ, opener=opener)
    left_out += [UnusedPart(path, problem.removeprefix(f"{path}: ")) for problem in capture.problems]
    if not datagrams:
        what = "no frame" if not capture.frames else f"none of its first {capture.frames} frames is a UCP datagram"
        left_out.append(UnusedPart(path, f"a capture, but it has {what}" if not capture.frames else what))
        return None
    mentioned = (name for each in datagrams.values() for name in (each.summary.block_hash, each.summary.chain_hash))
    hashes = frozenset(name.hex() for name in mentioned if name is not None)
    return CaptureSummary(path, capture.vehicle, capture.comment.epoch_us if capture.comment else None, hashes, path)


PUBLIC_SCHEMA = '"ucp-keys/1"'
"""A text that every file with public keys contains."""


def read_public_keys(path: Path, left_out: list[UnusedPart]) -> "PublicKeys | None":
    """Return the public keys in a file. If the keys cannot be used, return None and add the reason to `left_out`.
    Raises OSError.
    """
    try:
        from ucp.secure.bundle import load_public
        from ucp.secure.keyfile import KeyFileError
    except ModuleNotFoundError:
        left_out.append(UnusedPart(path, "public keys, which need the package cryptography (extra `secure`)"))
        return None
    try:
        return load_public(path)
    except KeyFileError as error:
        left_out.append(UnusedPart(path, f"public keys, but {str(error).removeprefix(f'{path}: ')}"))
        return None


def assign_keys(
    flights: Sequence[Flight], found: Sequence[tuple[Path, "PublicKeys"]], left_out: list[UnusedPart]
) -> None:
    """Assign public keys to each flight. Keys belong to a flight if they verify a signature in the exports of the
    flight. If any flight has signed blocks, keys that verify no signature belong to another mission and are omitted.
    """
    signed = {id(flight): [*_signed(flight)] for flight in flights} if found else {}
    unused = dict(found)
    for flight in flights:
        for path, keys in found:
            if any(_has_signed(keys, block) for block in signed[id(flight)]):
                flight.public_keys = keys
                unused.pop(path, None)
                break
    if any(signed.values()):
        left_out += [UnusedPart(path, "public keys of another mission, which sign no block here") for path in unused]


def read_mission_file(path: Path, left_out: list[UnusedPart]) -> Mission | None:
    """Return the mission in a mission file. If it is invalid, return None and add the reason to `left_out`."""
    try:
        return load_mission(path)
    except MissionError as error:
        left_out.append(UnusedPart(path, f"a mission file, but {str(error).removeprefix(f'{path}: ')}"))
        return None


def assign_mission_files(
    flights: Sequence[Flight], found: Sequence[tuple[Path, Mission]], left_out: list[UnusedPart]
) -> None:
    """Assign each mission file to the flights of its mission. If a flight has no roster, because it has no traces, it
    takes the roster from the mission file.
    """
    for path, mission in found:
        of_mission = [flight for flight in flights if flight.initial_data == mission.initial_data]
        for flight in of_mission:
            flight.mission_files.setdefault(mission.agent_id, path)
            flight.roster = flight.roster or mission.roster
        if not of_mission:
            left_out.append(UnusedPart(path, "a mission file of another mission, without other records"))


def _signed(flight: Flight) -> Iterator[ExportedBlock]:
    for export in flight.exports.values():
        yield from (block for block in export.blocks() if block.signature is not None)


def _has_signed(keys: "PublicKeys", block: ExportedBlock) -> bool:
    """Return true if the signature of a block is valid with these public keys."""
    from ucp.secure.block_signature import block_claim
    from ucp.secure.crypto_suite import verify

    public_key = keys.vehicles.get(block.agent_id)
    if public_key is None or block.signature is None:
        return False
    data = Block(block.agent_id, block.timestamp_us, block.event_bytes).block_data()
    return verify(block_claim(public_key, keys.mission, data, base64.b64decode(block.signature)))


_IMPORT_FILE = "import.json"
MAX_FILES = 10_000
MAX_DEPTH = 16
_HARNESS_FILES = {
    *(RUN_FILE, BEFORE_FINAL_RECONCILE, "vehicles", "network.jsonl", "tracks.jsonl", "rogue.jsonl", "lag.jsonl"),
    "channel.jsonl",
    *("report.html", "report.md", "junit.xml", "chains.svg"),
}
"""Names of files in a run directory that the harness wrote. All other files are from agents."""
_OTHER_RUN_FILES = re.compile(r"(\d+|capture|lab|rogue)\.(log|mission\.json|control|store)")
"""Names of other files in a run directory that contain no records of an agent."""
_INCARNATION_DIRECTORY = re.compile(r"\d+-\d+")


def files_of(paths: Iterable[Path], left_out: list[UnusedPart]) -> list[Path]:
    """Return the regular files at `paths`, each once. Raises FieldError if a path does not exist."""
    files: dict[Path, Path] = {}
    by_size: dict[int, list[Path]] = {}
    for path in paths:
        if not os.path.lexists(path):
            raise FieldError(f"{path}: does not exist; give files of a flight, or directories of such files")
        for file in _walk(path, left_out, named=True):
            if len(files) == MAX_FILES:
                left_out.append(
                    UnusedPart(file, f"it and all later files are not read, because at most {MAX_FILES} files are read")
                )
                return [*files.values()]
            try:
                real, size = file.resolve(strict=True), file.stat().st_size
                if real in files:
                    continue
                equal_files = (
                    other for other in by_size.get(size, ()) if size and filecmp.cmp(other, file, shallow=False)
                )
                equal_file = next(equal_files, None)
            except (OSError, RuntimeError) as error:
                why = getattr(error, "strerror", None) or "its links form a loop"
                left_out.append(UnusedPart(file, f"it cannot be read: {why}"))
                continue
            if equal_file is not None and is_incarnation_copy(file):
                continue
            if equal_file is not None:
                left_out.append(UnusedPart(file, f"its content equals {equal_file}"))
                continue
            files[real] = file
            by_size.setdefault(size, []).append(file)
    return [*files.values()]


def is_incarnation_copy(path: Path) -> bool:
    """Return true if the file is the copy of a single incarnation in a run directory.

    The main file of the agent usually contains the same records.
    """
    return path.parent.parent.name == "agents" and _INCARNATION_DIRECTORY.fullmatch(path.parent.name) is not None


def _walk(
    path: Path, left_out: list[UnusedPart], *, named: bool = False, depth: int = 0, in_run: bool = False
) -> Iterator[Path]:
    """Yield the files below a path. The function does not follow links inside a directory, because their targets often
    do not belong to the flight.
    """
    try:
        if path.is_symlink() and not named:
            left_out.append(UnusedPart(path, "it is a link; name its target if the target belongs to the flight"))
        elif path.is_dir():
            if depth > MAX_DEPTH:
                left_out.append(UnusedPart(path, f"it is below more than {MAX_DEPTH} directories"))
                return
            in_run = in_run or (path / RUN_FILE).is_file()
            ignored = _HARNESS_FILES if in_run else {_IMPORT_FILE}
            for inner in sorted(path.iterdir(), key=_files_first):
                if inner.name not in ignored and not (in_run and _OTHER_RUN_FILES.fullmatch(inner.name)):
                    yield from _walk(inner, left_out, depth=depth + 1, in_run=in_run)
        elif path.is_file():
            yield path
        else:
            left_out.append(
                UnusedPart(path, "it is not a regular file, but a FIFO, a socket, a device or a broken link")
            )
    except OSError as error:
        left_out.append(UnusedPart(path, f"it cannot be read: {error.strerror}"))


def _files_first(path: Path) -> tuple[bool, int, str]:
    """Return a sort key that puts files before directories, and short names before long names. For example, 9 comes
    before 10.
    """
    return path.is_dir(), len(path.name), path.name
