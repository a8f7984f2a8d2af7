"""Name blocks and chains in output. A block with a known name is shown by this name, such as `3.12`. Any other block is
shown by the first digits of its hash.

The names come from the exports of a run. Without exports, they come from the order of each agent's first proposals,
because an agent proposes its blocks in the order in which it completed them. This requires a capture that begins before
the agent's first datagram.
"""

from collections.abc import Iterable
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import name_blocks
from harness.archive.packets.capture_files import DIRECTORY
from harness.archive.packets.transmissions import Transmission
from harness.errors import CaptureError, RunDirectoryError
from ucp.messages import BlockAddRequest, CommitBlock

DIGITS = 8


class BlockNames:
    """The names of all blocks and chains in a set of transmitted messages."""

    def __init__(self, transmissions: Iterable[Transmission], runs: Iterable[Path]) -> None:
        """Collect the names. `runs` are directories that may contain exports."""
        self._blocks: dict[bytes, str] = {}
        self._top_of: dict[bytes, bytes | None] = {}
        self._mentioned: set[bytes] = set()
        self._sealed = False
        """True if some messages are encrypted, so that the blocks in these messages are unknown."""
        self._from_start: set[int] = set()
        self._proposed: dict[int, int] = {}
        for run in runs:
            self._learn_from_exports(run)
        known = bool(self._blocks)
        for transmission in transmissions:
            self._learn(transmission, known)

    def block(self, block_hash: bytes) -> str:
        return self._blocks.get(block_hash) or block_hash.hex()[:DIGITS]

    def known(self, block_hash: bytes) -> str | None:
        return self._blocks.get(block_hash)

    def chain(self, chain_hash: bytes) -> str:
        """Return the first digits of a chain hash, followed by the top block of the chain if this block is known."""
        digits = chain_hash.hex()[:DIGITS]
        if chain_hash not in self._top_of:
            return digits
        top = self._top_of[chain_hash]
        return f"{digits} ({'inception' if top is None else self.block(top)})"

    def find(self, query: str) -> bytes:
        """Return the hash of the block with this name, or of the block whose hash begins with this text.

        Raises CaptureError if no block or several blocks match.
        """
        named = [block_hash for block_hash, name in self._blocks.items() if name == query]
        hashes = named or [block_hash for block_hash in self._mentioned if block_hash.hex().startswith(query.lower())]
        hashes = [block_hash for block_hash in hashes if block_hash in self._mentioned]
        if len(hashes) == 1:
            return hashes[0]
        if hashes:
            raise CaptureError(f"--follow {query} fits {len(hashes)} blocks: give more digits of the hash")
        way_out = "--bundle shows what is sealed" if self._sealed else "give a name or a hash that is printed here"
        raise CaptureError(f"--follow {query}: no known message is about that block; {way_out}")

    def _learn_from_exports(self, run: Path) -> None:
        try:
            exports = RunArchive(run).exports.by_agent
        except RunDirectoryError:  # Captures from the field have no run directory.
            return
        self._blocks |= {bytes.fromhex(block_hash): name for block_hash, name in name_blocks(exports).items()}
        for export in exports.values():
            self._top_of[bytes.fromhex(export.inception.chain_hash)] = None
            for block in export.chain:
                if block.chain_hash:
                    self._top_of[bytes.fromhex(block.chain_hash)] = bytes.fromhex(block.block_hash)

    def _learn(self, transmission: Transmission, known: bool) -> None:
        summary = transmission.summary
        self._sealed |= summary.is_sealed
        if summary.block_hash is not None:
            self._mentioned.add(summary.block_hash)
        if transmission.origin == "forged":
            return
        if summary.message == CommitBlock.NAME and summary.chain_hash is not None:
            self._top_of[summary.chain_hash] = summary.block_hash
        if transmission.origin == "captured" and not transmission.sequence:
            self._from_start.add(transmission.sender)
        proposes = summary.message == BlockAddRequest.NAME and summary.block_hash is not None
        if (
            proposes
            and not known
            and transmission.sender in self._from_start
            and summary.block_hash not in self._blocks
        ):
            assert summary.block_hash is not None
            ordinal = self._proposed[transmission.sender] = self._proposed.get(transmission.sender, 0) + 1
            self._blocks[summary.block_hash] = f"{transmission.sender}.{ordinal}"


def run_directories(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories among `paths`, and the run directories that contain a capture file in `paths`."""
    runs = [
        path if path.is_dir() else path.resolve().parent.parent
        for path in paths
        if path.is_dir() or path.resolve().parent.name == DIRECTORY
    ]
    return list(dict.fromkeys(runs))
