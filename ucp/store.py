"""Store the data of an agent on the disk of its vehicle, so that it can continue after a power failure.

The store is a journal. An entry is a line: the CRC-32 of the rest in eight hexadecimal digits, a space, and JSON. The
first entry identifies the agent. Each other entry contains all changes that one input caused, as in a trace, and the
new blocks. The agent writes an entry before other agents can observe the changes. Because no entry contains only a part
of an input's changes, the entries from the first to any later line describe a state that the agent had. A reader stops
at the first damaged line.

An agent that boots writes a new journal with the recovered data, and replaces the old journal when the new one is on
disk. A valid journal therefore exists at any time.
"""

import base64
import contextlib
import errno
import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from ucp._dataclass import dataclass, field
from ucp.block import BLOCK_HEADER, Block
from ucp.messages import decode_block
from ucp.plain_file import open_plain_file, parse_json
from ucp.short_value import shown
from ucp.state import AgentState

SCHEMA = "ucp-store/1"
MAX_LINE_BYTES = 64 * 1024 * 1024

Change = tuple[str, str]
"""A change of an agent's state: the operation and the block hash, as in a trace."""


class StoreError(Exception):
    """An error: this agent must not change the store file. The message is one sentence."""


@dataclass(slots=True)
class SecuredState:
    """The data that a secured agent stores in addition: its start time, the signatures of blocks, and the received
    revocations.
    """

    started_us: int
    signatures: Mapping[bytes, bytes] = field(default_factory=dict, repr=False)
    revocations: tuple[bytes, ...] = ()

    def replay(self, entry: dict[str, Any]) -> None:
        """Add the data in one entry of the store file."""
        self.started_us = max(self.started_us, int(entry.get("started_us", 0)))
        new = {bytes.fromhex(name): base64.b64decode(text) for name, text in entry.get("signatures", {}).items()}
        self.signatures = {**self.signatures, **new}
        if (revocation := entry.get("revocation")) is not None:  # earlier versions stored only the newest one
            self.revocations = (base64.b64decode(revocation),)
        self.revocations = (*self.revocations, *map(base64.b64decode, entry.get("revocations", ())))

    def entry(self, before: "SecuredState | None" = None) -> dict[str, object]:
        """Return the data that changed since `before`, as one entry for the store file."""
        new: dict[str, Any] = {}
        if before is None:
            new["started_us"] = self.started_us
            before = SecuredState(self.started_us)
        if signed := self.signatures.keys() - before.signatures.keys():
            new["signatures"] = {name.hex(): _base64(self.signatures[name]) for name in sorted(signed)}
        if revoked := [body for body in self.revocations if body not in before.revocations]:
            new["revocations"] = [_base64(body) for body in revoked]
        return new


@dataclass(slots=True)
class StoredState:
    """The stored state of an agent."""

    completed: list[bytes] = field(default_factory=list)
    """Hashes of the blocks that the agent completed."""
    chain: list[Block] = field(default_factory=list)
    """Blocks of the chain without the inception block. The oldest is first."""
    deque: list[Block] = field(default_factory=list)
    """Blocks of the deque. The front is first."""
    stack: list[Block] = field(default_factory=list)
    """Blocks of the reconcile stack. The top is last."""
    secured: SecuredState | None = None
    """Additional data of a secured agent. None if the mission has no keys."""

    @classmethod
    def of(cls, state: AgentState) -> "StoredState":
        return cls(
            list(state.completed), list(state.chain), list(state.blocks_to_be_committed), list(state.reconcile_stack)
        )

    def blocks(self) -> Iterator[Block]:
        yield from self.chain
        yield from self.deque
        yield from self.stack

    def encode(self) -> bytes:
        """Encode the blocks of chain, deque and reconcile stack, in this order. A length (u16) precedes each block."""
        return b"".join(len(data).to_bytes(2, "big") + data for data in (block.block_data() for block in self.blocks()))

    def check(self) -> None:
        """Raise ValueError if no agent can have this state."""
        held = [block.block_hash for block in self.blocks()]
        if len({*held}) < len(held) or not {*self.completed} <= {*held}:
            raise ValueError("a block is stored twice, or a completed block is missing")

    def _change(self, operation: str, block: Block) -> None:
        """Apply one change of the state. A change is an operation on a block, such as "chain+"."""
        match operation:
            case "complete":
                self.completed.append(block.block_hash)
            case "chain+":
                self.chain.append(block)
            case "chain-":
                self.chain.pop()
            case "deque+":
                self.deque.append(block)
            case "deque-":
                self.deque.pop(0)
            case "stack+":
                self.stack.append(block)
            case "stack-":
                self.stack.remove(block)

    def replay(self, entry: dict[str, Any], known: dict[str, Block]) -> None:
        """Apply all changes in one entry of the store file. Add the blocks in the entry to `known`, which maps block
        hashes to the blocks of all entries so far.
        """
        for agent_id, timestamp_us, event_data in entry["blocks"]:
            block = block_on_disk(agent_id, timestamp_us, base64.b64decode(event_data))
            known[block.block_hash.hex()] = block
        for operation, block_hash in entry["changes"]:
            self._change(operation, known[block_hash])
        if "secured" in entry:
            if self.secured is None:
                self.secured = SecuredState(0)
            self.secured.replay(entry["secured"])


class Store:
    """The stored data of an agent in the file `path`. Raises OSError, or StoreError if the file belongs to another
    agent.

    `state` is the state of the agent. `recovered` is the data of an earlier incarnation, or None.
    """

    def __init__(self, path: Path, state: AgentState) -> None:
        self.problem: str | None = None
        """The disk error after which the agent stopped writing the store. None if there was no error."""
        self._path = path
        self._state = state
        self._header = {
            "schema": SCHEMA,
            "agent_id": state.agent_id,
            "inception": state.chain.inception.block_hash.hex(),
        }
        self._written: set[str] = set()
        self._secured: SecuredState | None = None
        """The data of a secured agent as it was last written to the disk."""
        self._file: BinaryIO | None = None
        self.recovered = self._read()

    def _read(self) -> StoredState | None:
        if not self._path.parent.is_dir():
            raise StoreError(f"{self._path} cannot be written: the directory {self._path.parent} does not exist")
        if self._path.exists() and not self._path.is_file():
            raise StoreError(f"{self._path} is not a file: set `store` to the path of another file")
        header, stored = read_store(self._path)
        if not isinstance(header, dict):
            if self._path.exists() and self._path.stat().st_size:
                raise StoreError(f"{self._path} is not a store: move the file away, or set `store` to another path")
            return None
        if header != self._header:
            raise StoreError(
                f"{self._path} is the store of agent {shown(header.get('agent_id'))} in another mission, or of "
                "another version: set `store` to another path"
            )
        return stored

    def write(self, changes: list[Change], secured: SecuredState | None = None) -> None:
        """Write the changes of one input to the disk. The first write after a start also contains the restored data.

        `secured` is the additional data of a secured agent.
        """
        if self.problem is not None:
            return
        secured_entry = {} if secured is None else secured.entry(self._secured)
        self._secured = secured
        if not (changes or secured_entry):
            return
        new = dict.fromkeys(block_hash for _, block_hash in changes if block_hash not in self._written)
        blocks = [self._block(block_hash) for block_hash in new]
        entry = {
            "changes": changes,
            "blocks": [[block.agent_id, block.timestamp_us, _base64(block.event_data)] for block in blocks],
            **({"secured": secured_entry} if secured_entry else {}),
        }
        try:
            if self._file is None:
                self._file = self._replace_journal(_line(self._header) + _line(entry))
            else:
                _append(self._file, _line(entry))
        except OSError as error:
            self.problem = error.strerror or str(error)
        self._written.update(new)

    def _replace_journal(self, lines: bytes) -> BinaryIO:
        """Replace the file by a new one that begins with these lines."""
        temporary = self._path.with_name(f".{self._path.name}.new")
        file = temporary.open("wb", buffering=0)
        try:
            _append(file, lines)
            temporary.replace(self._path)
            _sync_directory(self._path.parent)
        except BaseException:
            file.close()
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        return file

    def _block(self, block_hash: str) -> Block:
        state = self._state
        held = state.chain.get(bytes.fromhex(block_hash))
        if held is not None:
            return held
        aside = (*state.blocks_to_be_committed, *state.reconcile_stack)
        return next(block for block in aside if block.block_hash.hex() == block_hash)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def read_store(path: Path) -> tuple[Any, StoredState]:
    """Read a store file. Return its header and the state after the last complete entry. The header is None if the store
    is empty.

    Raises OSError, or StoreError for an entry that has a valid checksum but was not written by an agent.
    """
    entries = _entries(path)
    stored, known = StoredState(), dict[str, Block]()
    try:
        header = next(entries, None)
        for entry in entries:
            stored.replay(entry, known)
        stored.check()
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        raise StoreError(
            f"{path} has an impossible entry with a valid checksum: move the file away, or set `store` to another path"
        ) from None
    return header, stored


def block_on_disk(agent_id: int, timestamp_us: int, event_data: bytes) -> Block:
    """Decode a block that was read from the disk. Raises ValueError if the block is invalid, or too large for a
    message.
    """
    try:
        return decode_block(BLOCK_HEADER.pack(agent_id, timestamp_us) + event_data)
    except struct.error as error:
        raise ValueError(str(error)) from None


def _line(document: dict[str, Any]) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _append(file: BinaryIO, lines: bytes) -> None:
    """Append lines to the file and force them to the disk. Raises OSError."""
    if file.write(lines) != len(lines):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.fdatasync(file.fileno())


def _sync_directory(path: Path) -> None:
    """Force the names of new files in this directory to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _entries(path: Path) -> Iterator[Any]:
    """Yield the entries of a store up to the first damaged one. A missing file has no entries.

    Raises OSError, or ValueError for an undamaged entry that is not JSON.
    """
    try:
        file = open_plain_file(path)
    except FileNotFoundError:
        return
    with file:
        while line := file.readline(MAX_LINE_BYTES):
            checksum, _, text = line.partition(b" ")
            try:
                whole = int(checksum, 16) == zlib.crc32(text.removesuffix(b"\n"))
            except ValueError:
                return
            if not whole:
                return
            yield parse_json(text)


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
