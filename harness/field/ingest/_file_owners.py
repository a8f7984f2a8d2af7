"""Find the flights of files that do not name their flight: packet captures, public keys, and mission files."""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import ExportedBlock
from harness.archive.packets.capture_reader import Capture, Datagram
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
    """Assign public keys to each flight. A flight gets the keys that verify a signature in its exports.

    If any block is signed, unused keys belong to another mission and are omitted.
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
    """Assign each mission file to the flights of its mission. A flight without traces gets its roster."""
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
