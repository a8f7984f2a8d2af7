"""Read chain exports (`ucp-chain-export/1`) of a run or a real flight, and name their blocks.

Exports from the field may be truncated, edited, duplicated or from another mission. Each unusable file gets one
sentence, and the other files are read. This module validates only the format. The checker verifies the hashes
(characteristic 4).
"""

import base64
import binascii
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from harness.archive.trace_files import trace_files
from harness.errors import ExportError, RunDirectoryError
from ucp.block import HASH_BYTES, MAX_AGENT_ID, MAX_EVENT_DATA_BYTES, Block
from ucp.export import SCHEMA
from ucp.plain_file import json_problem, read_json
from ucp.state import AgentState

RUN_FILE = "run.json"
SUFFIX = ".chain.json"
BEFORE_FINAL_RECONCILE = "before_final_reconcile"
"""Name of the directory in a run directory that contains the exports from before the final reconcile."""
MAX_EXPORT_BYTES = 32 * 1024 * 1024
"""Maximum size of an export in bytes. An export of this size contains about 17,000 blocks."""
MAX_ERRORS = 20_000
"""Maximum number of errors that are described for one file. Each description takes a kilobyte."""

MAX_SIGNATURE = 4 * (64 // 3 + 1)
"""Length of 64 bytes in base64, in characters."""

Hash = Annotated[str, Field(pattern=rf"^[0-9a-f]{{{2 * HASH_BYTES}}}$")]
AgentId = Annotated[int, Field(ge=1, le=MAX_AGENT_ID, strict=True)]


def _decodable(text: str) -> str:
    try:
        base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"not base64: {error}") from None
    return text


Base64 = Annotated[str, AfterValidator(_decodable)]
EncodedEventData = Annotated[Base64, Field(max_length=4 * (MAX_EVENT_DATA_BYTES // 3 + 1))]


class ExportedBlock(BaseModel):
    """An exported block. `chain_hash` is null if the block is not in the chain. `signature` is the signature of the
    agent that completed the block. It exists only in a secured mission.
    """

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    agent_id: AgentId
    timestamp_us: Annotated[int, Field(ge=0, lt=2**64, strict=True)]
    event_data: EncodedEventData
    block_hash: Hash
    chain_hash: Hash | None
    signature: Annotated[
        Base64 | None, Field(max_length=MAX_SIGNATURE, exclude_if=lambda signature: signature is None)
    ] = None

    @property
    def event_bytes(self) -> bytes:
        """The encoded events of a block (Section 3.1), which may be encrypted."""
        return base64.b64decode(self.event_data)


class ExportedInception(BaseModel):
    """The inception block, which is the same for all agents of a mission. Its data is in base64."""

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    block_data: Base64
    block_hash: Hash
    chain_hash: Hash

    @property
    def data(self) -> bytes:
        """The data of the inception block, which all agents of the mission received (Section 3.4.1)."""
        return base64.b64decode(self.block_data)


class CurrentBlock(BaseModel):
    """The incomplete block of an agent: its events so far, in base64."""

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    event_data: EncodedEventData


class ExportedHead(BaseModel):
    """The signed head of an export in a secured mission. The agent contract defines which bytes are signed."""

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    mission: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    boot: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    number: Annotated[int, Field(ge=1, lt=2**32, strict=True)]
    """The number of the export in this incarnation, counted from 1."""
    height: Annotated[int, Field(ge=0, lt=2**32, strict=True)]
    top_chain_hash: Hash
    completed: Hash
    """Digest of the list `completed`."""
    held: Hash
    """Digest of deque, reconcile stack, current block and flags."""
    revoked: Annotated[list[AgentId], Field(max_length=MAX_AGENT_ID)]
    """The agents that were revoked according to the revocations that this agent knew, in ascending order."""
    signature: Annotated[Base64, Field(max_length=MAX_SIGNATURE)]


class Export(BaseModel):
    """The chain export of one agent. Unknown fields are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)

    schema_: Annotated[Literal["ucp-chain-export/1"], Field(alias="schema")]
    agent_id: AgentId
    exported_at_us: Annotated[int, Field(ge=0, strict=True)]
    inception: ExportedInception
    chain: list[ExportedBlock]
    blocks_to_be_committed: list[ExportedBlock]
    reconcile_stack: list[ExportedBlock]
    current_block: CurrentBlock
    reconcile_in_progress: bool
    idle: bool
    completed: list[Hash]
    head: Annotated[ExportedHead | None, Field(exclude_if=lambda head: head is None)] = None
    """The signed head of the export. It exists only in a secured mission."""

    @property
    def top_chain_hash(self) -> str:
        """The hash of the whole chain. If the chain is empty, it is the chain hash of the inception block."""
        top = self.chain[-1].chain_hash if self.chain else None
        return top or self.inception.chain_hash

    @cached_property
    def chain_of_block_hashes(self) -> tuple[str, ...]:
        """The block hashes of the chain without the inception block. The oldest is first."""
        return tuple(block.block_hash for block in self.chain)

    def blocks(self) -> Iterable[ExportedBlock]:
        """Yield each block that the agent holds: in its chain, its deque and its reconcile stack."""
        yield from self.chain
        yield from self.blocks_to_be_committed
        yield from self.reconcile_stack


@dataclass
class Exports:
    """The exports of one mission, by agent. `errors` contains a sentence for each file that cannot be used."""

    by_agent: dict[int, Export] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)


class ExportMaker:
    """A maker of chain exports for agents in this process, without files. Agents that hold the same block share one
    object for it.
    """

    def __init__(self) -> None:
        self._blocks: dict[tuple[bytes, bytes | None, bytes | None], ExportedBlock] = {}
        self._event_data: dict[bytes, str] = {}

    def export(
        self,
        state: AgentState,
        exported_at_us: int,
        signatures: Mapping[bytes, bytes] | None = None,
        head: Mapping[str, Any] | None = None,
    ) -> Export:
        """Return the export of an agent as an object. The object equals the result of `read_export` on the file of the
        export. `head` is the signed head of a secured agent.
        """
        inception, signed = state.chain.inception, signatures or {}
        return Export.model_construct(
            schema_=SCHEMA,
            agent_id=state.agent_id,
            exported_at_us=exported_at_us,
            inception=ExportedInception.model_construct(
                block_data=_base64(inception.block_data),
                block_hash=inception.block_hash.hex(),
                chain_hash=inception.chain_hash.hex(),
            ),
            chain=[self._block(block, chain_hash, signed) for block, chain_hash in state.chain.with_chain_hashes()],
            blocks_to_be_committed=[self._block(block, None, signed) for block in state.blocks_to_be_committed],
            reconcile_stack=[self._block(block, None, signed) for block in state.reconcile_stack],
            current_block=CurrentBlock.model_construct(event_data=_base64(bytes(state.current_block))),
            reconcile_in_progress=state.reconcile_in_progress,
            idle=state.idle,
            completed=[block_hash.hex() for block_hash in state.completed],
            head=None if head is None else ExportedHead.model_validate(head),
        )

    def _block(self, block: Block, chain_hash: bytes | None, signed: Mapping[bytes, bytes]) -> ExportedBlock:
        signature = signed.get(block.block_hash)
        key = block.block_hash, chain_hash, signature
        exported = self._blocks.get(key)
        if exported is None:
            event_data = self._event_data.setdefault(block.block_hash, _base64(block.event_data))
            exported = self._blocks[key] = ExportedBlock.model_construct(
                agent_id=block.agent_id,
                timestamp_us=block.timestamp_us,
                event_data=event_data,
                block_hash=block.block_hash.hex(),
                chain_hash=chain_hash.hex() if chain_hash else None,
                signature=_base64(signature) if signature else None,
            )
        return exported


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def read_export(path: Path) -> Export:
    """Read an export. Raises ExportError with a message that names the file, the error and the place of the error."""
    try:
        document = read_json(path, MAX_EXPORT_BYTES)
    except OSError as error:
        raise ExportError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise json_error(path, error) from None
    return parse_export(path, document)


def json_error(path: Path, error: ValueError) -> ExportError:
    """Return the error for an export that is not JSON or exceeds the limits of `parse_json`."""
    return ExportError(f"{path}: truncated or damaged: {json_problem(error)}; export it again")


def parse_export(path: Path, document: Any) -> Export:
    """Return the export in a JSON document. `path` is the name of its file. Raises ExportError like `read_export`."""
    if not isinstance(document, dict) or "schema" not in document:
        raise ExportError(f"{path}: not a chain export (it has no `schema`)")
    if document["schema"] != SCHEMA:
        raise ExportError(f"{path}: its schema is {str(document['schema'])[:40]!r}, and this version reads {SCHEMA!r}")
    try:
        return Export.model_validate(document)
    except ValidationError as error:
        raise ExportError(f"{path}: {_first_problem(error)}") from None


def read_exports(paths: Iterable[Path]) -> Exports:
    """Read the exports of one mission. In the result, `errors` contains a sentence for each unusable file.

    If the exports belong to several missions, use the mission with the most exports. If several missions have this
    highest number of exports, use the one to which the first file belongs. If an agent has two different exports, use
    the later one.
    """
    exports = Exports()
    read: list[tuple[Path, Export]] = []
    for path in paths:
        try:
            read.append((path, read_export(path)))
        except ExportError as error:
            exports.errors.append(str(error))
    if not read:
        return exports
    missions = Counter(export.inception.block_hash for _, export in read)
    mission = max(missions, key=lambda block_hash: missions[block_hash])
    source: dict[int, Path] = {}
    for path, export in read:
        if export.inception.block_hash != mission:
            exports.errors.append(
                f"{path}: agent {export.agent_id} belongs to another mission (inception block "
                f"{export.inception.block_hash[:12]}, not {mission[:12]}); check each mission separately"
            )
            continue
        other = exports.by_agent.get(export.agent_id)
        if other == export:
            exports.errors.append(f"{path}: the same export as {source[export.agent_id]}, counted once")
            continue
        if other is not None:
            later, earlier = (path, source[export.agent_id])
            if other.exported_at_us > export.exported_at_us:
                later, earlier = earlier, later
            exports.errors.append(f"{earlier}: not used, because agent {export.agent_id} has a later export: {later}")
            if later != path:
                continue
        exports.by_agent[export.agent_id] = export
        source[export.agent_id] = path
    exports.by_agent = dict(sorted(exports.by_agent.items()))
    return exports


def export_paths(directory: Path) -> list[Path]:
    """Return the exports in a run directory, or in a directory of exports, in order of agent IDs."""
    paths = (path for path in agents_directory(directory).glob(f"*{SUFFIX}") if path.exists())
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def agents_directory(directory: Path) -> Path:
    """Return the directory with exports and traces. This is the directory `agents` in a run directory, otherwise
    `directory` itself.
    """
    agents = directory / "agents"
    return agents if agents.is_dir() else directory


def export_files(paths: Iterable[Path]) -> list[Path]:
    """Return the export files at `paths`. A path is an export file, a run directory, or a directory of exports.

    A run directory or a directory of traces may contain no exports. Raises RunDirectoryError if a path does not exist,
    or is a directory with other files.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            exports = export_paths(path)
            if not exports and not (path / RUN_FILE).exists() and not _holds_traces(path):
                raise RunDirectoryError(f"{path}: neither a run directory nor a directory with *{SUFFIX} files")
            files += exports
        elif path.exists():
            files.append(path)
        else:
            raise RunDirectoryError(f"{path}: does not exist; give a run directory or exports (*{SUFFIX})")
    return files


def _holds_traces(directory: Path) -> bool:
    return bool(trace_files(agents_directory(directory)))


def _first_problem(error: ValidationError) -> str:
    if error.error_count() > MAX_ERRORS:
        return f"{error.error_count()} errors in it; the export was edited or damaged"
    problem: Any = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"`{where}` is wrong: {problem['msg'].lower()}{more}; the export was edited or damaged"


def name_blocks(exports: Mapping[int, Export]) -> dict[str, str]:
    """Return the name of every block, by block hash. For example, `4.11` is the 11th block that agent 4 completed.

    If an agent was killed and left no export, its blocks are ordered by their timestamps in the exports of other
    agents.
    """
    completed: dict[int, dict[str, int]] = {
        agent_id: dict.fromkeys(export.completed, 0) for agent_id, export in exports.items()
    }
    unexported: dict[int, dict[str, int]] = {}
    for export in exports.values():
        for block in export.blocks():
            if block.block_hash not in completed.get(block.agent_id, {}):
                unexported.setdefault(block.agent_id, {})[block.block_hash] = block.timestamp_us
    for agent_id, blocks in unexported.items():
        by_time = sorted(blocks, key=lambda block_hash: (blocks[block_hash], block_hash))
        completed.setdefault(agent_id, {}).update(dict.fromkeys(by_time, 0))
    return {
        block_hash: f"{agent_id}.{ordinal}"
        for agent_id, blocks in sorted(completed.items())
        for ordinal, block_hash in enumerate(blocks, start=1)
    }
