"""Owners of files without a name: the mission of a capture, and the flight of a set of public keys."""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from harness.archive.exports import ExportedBlock
from harness.archive.packets.capture_reader import Capture, Datagram
from harness.field.ingest._ingest import Flight, LeftOut
from ucp.block import Block

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
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
        what = "no frame" if not capture.frames else f"none of its first {capture.frames} frames is a UCP datagram"
        left_out.append(LeftOut(path, f"a capture, but it has {what}" if not capture.frames else what))
        return None
    named = (name for each in datagrams.values() for name in (each.summary.block_hash, each.summary.chain_hash))
    hashes = frozenset(name.hex() for name in named if name is not None)
    return Glance(path, capture.vehicle, capture.comment.epoch_us if capture.comment else None, hashes, path)


PUBLIC_SCHEMA = '"ucp-keys/1"'
"""What a file of public keys has in it."""


def read_public_keys(path: Path, left_out: list[LeftOut]) -> "PublicKeys | None":
    """Those in a file; None if they cannot be used, which is told in `left_out`. Raises OSError."""
    try:
        from ucp.secure.bundle import load_public
        from ucp.secure.keyfile import KeyFileError
    except ModuleNotFoundError:
        left_out.append(LeftOut(path, "public keys, which need the package cryptography (extra `secure`)"))
        return None
    try:
        return load_public(path)
    except KeyFileError as error:
        left_out.append(LeftOut(path, f"public keys, but {str(error).removeprefix(f'{path}: ')}"))
        return None


def give_keys(flights: Sequence[Flight], found: Sequence[tuple[Path, "PublicKeys"]], left_out: list[LeftOut]) -> None:
    """Each flight gets those that a block of its exports is signed with; if any block is, others are `left_out`."""
    signed = {id(flight): [*_signed(flight)] for flight in flights} if found else {}
    unused = dict(found)
    for flight in flights:
        for path, keys in found:
            if any(_has_signed(keys, block) for block in signed[id(flight)]):
                flight.public_keys = keys
                unused.pop(path, None)
                break
    if any(signed.values()):
        left_out += [LeftOut(path, "public keys of another mission, which sign no block here") for path in unused]


def _signed(flight: Flight) -> Iterator[ExportedBlock]:
    for export in flight.exports.values():
        yield from (block for block in export.blocks() if block.signature is not None)


def _has_signed(keys: "PublicKeys", block: ExportedBlock) -> bool:
    """Whether the vehicle that the block names has signed it in this mission."""
    from ucp.secure.block_signature import claim_of_block
    from ucp.secure.crypto_suite import verify

    public_key = keys.vehicles.get(block.agent_id)
    if public_key is None or block.signature is None:
        return False
    data = Block(block.agent_id, block.timestamp_us, block.event_bytes).block_data()
    return verify(claim_of_block(public_key, keys.mission, data, base64.b64decode(block.signature)))
