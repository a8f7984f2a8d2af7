"""Read the chain exports of a mission. If an export is damaged, use all of its undamaged parts.

A truncated export is used up to its end. An edited or damaged export is used without its damaged parts. The hash of a
block is computed from its content (eq. 3.1). A different hash in the file is reported. If several vehicles hold the
same block, memory contains one object for it.
"""

import base64
import json
import re
from binascii import a2b_base64
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, ValidationError

from harness.archive.archive import RunArchive
from harness.archive.bounded_file import BoundedFile
from harness.archive.exports import (
    MAX_EXPORT_BYTES,
    RUN_FILE,
    SUFFIX,
    AgentId,
    CurrentBlock,
    Export,
    ExportedBlock,
    ExportedInception,
    json_error,
)
from harness.archive.record_file import validate_leniently
from harness.archive.traces import read_trace
from harness.archive.vocabulary import unknown_names
from harness.checker.signatures import TrustedKeys, vouch
from harness.errors import ExportError
from harness.field.depot.mission_comparison import INCEPTION, ROSTER, ComparedFile, UnreadableFileError
from harness.field.depot.mission_comparison import read as read_compared_file
from harness.field.flight_logs import FlightLog, flight_log_kind, read_flight_log
from harness.field.ingest import UnusedPart
from harness.field.ingest._file_owners import files_of
from harness.gc_pause import gc_paused
from harness.report.logbook import logged_telemetry
from ucp.block import BLOCK_HEADER, InceptionBlock, next_chain_hash
from ucp.export import SCHEMA
from ucp.plain_file import parse_json

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys

HASH_DIGITS = 12
MAX_NAMED = 5
BEGINNING_BYTES = 4096
_FORMAT = SCHEMA.partition("/")[0].encode()
EXPORT_AGAIN = "export it again if you can"


@dataclass(frozen=True)
class ReadExport:
    """A chain export and its file."""

    path: Path
    export: Export
    """The export. Its hashes are computed from the content of the blocks."""
    problems: list[str]
    """A sentence for each error in the file."""
    claims: dict[str, str]
    """The wrong hashes that the file contains for blocks, by the computed hash of the block."""

    def blocks(self) -> set[str]:
        """Return the hashes of all blocks in the export."""
        return {block.block_hash for block in self.export.blocks()}


@dataclass
class CollectedExports:
    """The exports of one mission."""

    latest: dict[int, ReadExport]
    """The latest export of each agent, by agent ID."""
    earlier: list[ReadExport]
    """Earlier exports of the agents in `latest`."""
    left_out: list[str]
    """A sentence for each unused file."""
    remarks: list[str]
    """Sentences with further facts about the used files."""
    roster: set[int] = field(default_factory=set)
    """The IDs of the agents that occur in other files of the mission: mission files, traces, a manifest, or the record
    of the run.
    """
    traced: dict[int, list[str]] = field(default_factory=dict)
    """The hashes of the blocks that each agent completed according to its trace, by agent ID."""
    flight_logs: list[FlightLog] = field(default_factory=list)
    telemetry: bool = True
    """False if a file shows that the events are not telemetry of vehicles. True otherwise."""
    wrong_signatures: list[str] = field(default_factory=list)
    """A sentence about each wrong signature in a secured mission."""
    unproven: str | None = None
    """The reason why the signatures do not prove that the exports are genuine, for example because no public keys are
    known. The value is None if valid signatures prove it, or if the mission was not secured.
    """

    @property
    def read_exports(self) -> list[ReadExport]:
        return [*self.latest.values(), *self.earlier]

    @property
    def exports(self) -> dict[int, Export]:
        """The latest export of each agent."""
        return {agent_id: read_export.export for agent_id, read_export in self.latest.items()}

    @property
    def inception(self) -> ExportedInception:
        return next(iter(self.latest.values())).export.inception

    @property
    def problems(self) -> list[str]:
        problems = [problem for read_export in self.read_exports for problem in read_export.problems]
        return [*problems, *self.wrong_signatures]

    @property
    def claims(self) -> dict[str, str]:
        """The wrong hashes that files contain for blocks, by the computed hash of the block. A block is omitted if the
        computed hash is confirmed: if another export contains the block with this hash, or if an agent completed a
        block with this hash.
        """
        claims = {true: claimed for read_export in self.read_exports for true, claimed in read_export.claims.items()}
        for read_export in self.read_exports if claims else ():
            for good in {*read_export.export.completed, *(read_export.blocks() - read_export.claims.keys())}:
                claims.pop(good, None)
        return claims


@gc_paused()
def collect_exports(paths: Iterable[Path], keys: "PublicKeys | None" = None) -> CollectedExports:
    """Read the exports in these files and directories. Return the exports of the mission with the most agents. `keys`
    are public keys that the user trusts. Without `keys`, the keys in the directories verify the signatures. Raises
    FieldError if a path does not exist, and ExportError if no export is usable.
    """
    reader, read_exports, left_out = _ExportReader(), list[ReadExport](), list[str]()
    skipped, context_files, flight_logs = list[UnusedPart](), list[ComparedFile](), list[FlightLog]()
    paths = list(paths)
    for path in files_of(paths, skipped):
        if _is_flight_log(path):
            flight_logs.append(read_flight_log(path))
            continue
        named_by_user = path in paths or path.name.endswith(SUFFIX)
        try:
            read_exports.append(reader.read(path, named_by_user=named_by_user))
        except NotAnExportError as error:
            try:
                context_files.append(read_compared_file(path))
            except UnreadableFileError:
                left_out += [str(error)] if named_by_user else []
        except ExportError as error:
            left_out.append(str(error))
    if not read_exports:
        why = left_out[0] if left_out else "no file contains a chain export"
        more = f" (and {len(left_out) - 1} files more)" if len(left_out) > 1 else ""
        raise ExportError(f"none of these files is usable: {why}{more}")
    mission = _largest_mission(read_exports)
    left_out += _other_missions(read_exports, mission)
    collected = _by_agent([each for each in read_exports if each.export.inception.block_hash == mission], left_out)
    collected.remarks += [each.sentence for each in skipped]
    collected.flight_logs = flight_logs
    collected.remarks += [f"{log.path}: {problem}" for log in flight_logs for problem in log.problems]
    _add_context(collected, [each for each in context_files if each.shared[INCEPTION].value == mission])
    _add_signatures(collected, paths, keys)
    return collected


def _add_signatures(collected: CollectedExports, paths: Iterable[Path], keys: "PublicKeys | None") -> None:
    """Verify the signatures of a secured mission, and add the results to the problems and remarks."""
    archive = RunArchive(*(path for path in paths if path.is_dir() and _is_archive(path)), keys=keys)
    public = archive.public_keys
    trusted = TrustedKeys(public, archive.anchor) if public is not None else None
    exports = [each.export for each in collected.read_exports]
    collected.wrong_signatures, collected.unproven = vouch(exports, trusted)
    if collected.unproven is not None:
        collected.remarks.append(collected.unproven)


def _is_archive(directory: Path) -> bool:
    return (directory / RUN_FILE).is_file() or any(directory.glob(f"*{SUFFIX}"))


def _is_flight_log(path: Path) -> bool:
    try:
        with BoundedFile(path) as file:
            return flight_log_kind(path, file.peek(BEGINNING_BYTES)[:BEGINNING_BYTES]) is not None
    except OSError:
        return False  # the reader of exports reports the error


def _add_context(collected: CollectedExports, compared_files: Iterable[ComparedFile]) -> None:
    """Add facts from the other files of the mission: the roster, and whether the events are telemetry."""
    for each in compared_files:
        if each.kind == "trace" and each.agent_id is not None:
            trace = read_trace(each.path, skim=True)
            collected.traced.setdefault(each.agent_id, []).extend(trace.completed() if trace else ())
            if unknown := unknown_names(trace.runs if trace else ()).get("operation"):
                collected.remarks.append(
                    f"{each.path}: {unknown}, so the completed blocks of agent {each.agent_id} are unknown"
                )
        if ROSTER in each.shared:
            collected.roster.update(each.shared[ROSTER].value)  # type: ignore[arg-type]
        if each.mission is not None and each.mission.events.source == "random":
            collected.telemetry = False
    directories = (
        directory
        for read_export in collected.read_exports
        for directory in (read_export.path.parent, read_export.path.parent.parent)
    )
    run = next((directory for directory in dict.fromkeys(directories) if (directory / RUN_FILE).is_file()), None)
    if run is not None:
        record = RunArchive(run).record
        collected.roster.update(record.known_agents)
        collected.telemetry = logged_telemetry(record)


class NotAnExportError(ExportError):
    """An error: a file is not a chain export of a known format."""


def _largest_mission(read_exports: Iterable[ReadExport]) -> str:
    """Return the hash of the inception block of the mission with the most agents. If several missions have the same
    number of agents, return the mission with the most blocks.
    """
    agents: dict[str, set[int]] = {}
    blocks: Counter[str] = Counter()
    for each in read_exports:
        mission = each.export.inception.block_hash
        agents.setdefault(mission, set()).add(each.export.agent_id)
        blocks[mission] += len(each.export.chain)
    return max(agents, key=lambda mission: (len(agents[mission]), blocks[mission]))


def _other_missions(read_exports: Iterable[ReadExport], mission: str) -> Iterator[str]:
    others: dict[str, list[Path]] = {}
    for each in read_exports:
        if each.export.inception.block_hash != mission:
            others.setdefault(each.export.inception.block_hash, []).append(each.path)
    for other, files in others.items():
        names = ", ".join(map(str, files[:MAX_NAMED]))
        more = f" and {len(files) - MAX_NAMED} more" if len(files) > MAX_NAMED else ""
        are = "are" if len(files) > 1 else "is"
        yield (
            f"{names}{more}: {are} of another mission (inception block {other[:HASH_DIGITS]}, not "
            f"{mission[:HASH_DIGITS]}); consolidate {'them by themselves' if len(files) > 1 else 'it by itself'}"
        )


def _by_agent(read_exports: Iterable[ReadExport], left_out: list[str]) -> CollectedExports:
    """Find the latest export of each agent, which contains the current state of the agent. Also keep earlier exports,
    because they may contain further blocks.
    """
    collected = CollectedExports({}, [], left_out, [])
    for each in read_exports:
        agent_id = each.export.agent_id
        other = collected.latest.get(agent_id)
        if other is None:
            collected.latest[agent_id] = each
            continue
        if other.export == each.export:
            collected.remarks.append(f"{each.path}: the same export as {other.path}, counted once")
            continue
        age = each.export.exported_at_us, len(each.export.completed), len(each.export.chain)
        its_age = other.export.exported_at_us, len(other.export.completed), len(other.export.chain)
        earlier, collected.latest[agent_id] = (other, each) if age >= its_age else (each, other)
        collected.earlier.append(earlier)
        collected.remarks.append(
            f"{earlier.path}: agent {agent_id} exported its chain again later, in {collected.latest[agent_id].path}: "
            "the later export is current; the earlier one is recorded as well"
        )
    collected.latest = dict(sorted(collected.latest.items()))
    return collected


# A file


class _PartialExport(Export):
    """An export with a default value for every missing key."""

    agent_id: AgentId | None = None  # type: ignore[assignment]
    exported_at_us: Annotated[int, Field(ge=0, strict=True)] = 0
    inception: ExportedInception | None = None  # type: ignore[assignment]
    chain: list[ExportedBlock] = []  # noqa: RUF012 - pydantic copies it
    blocks_to_be_committed: list[ExportedBlock] = []  # noqa: RUF012
    reconcile_stack: list[ExportedBlock] = []  # noqa: RUF012
    current_block: CurrentBlock = CurrentBlock(event_data="")
    reconcile_in_progress: bool = False
    idle: bool = False
    completed: list[str] = Field(default=[])


class _ExportReader:
    """A reader of chain exports that stores each block once, even if several exports contain it."""

    def __init__(self) -> None:
        self._hashes: dict[tuple[int, int, str], str] = {}
        self._blocks: dict[tuple[str, str | None], ExportedBlock] = {}

    def read(self, path: Path, *, named_by_user: bool) -> ReadExport:
        """Read a chain export, and return its undamaged part.

        Raises NotAnExportError for a file of another format, and ExportError if no part is usable.
        """
        data = _content(path, named_by_user)
        problems: list[str] = []
        try:
            export = Export.model_validate(parse_json(data))
        except ValueError:
            export = _recover(path, data, problems)
        return self._with_true_hashes(path, export, problems)

    def _with_true_hashes(self, path: Path, export: Export, problems: list[str]) -> ReadExport:
        inception = InceptionBlock(base64.b64decode(export.inception.block_data))
        true = ExportedInception(
            block_data=export.inception.block_data,
            block_hash=inception.block_hash.hex(),
            chain_hash=inception.chain_hash.hex(),
        )
        if true != export.inception:
            problems.append(f"{path}: the hashes of its inception block do not match its data: it was edited")
        claims: dict[str, str] = {}
        chain, chain_hash, broken_at = list[ExportedBlock](), inception.chain_hash, None
        for position, block in enumerate(export.chain, 1):
            block_hash = self._hash(block)
            chain_hash = next_chain_hash(chain_hash, bytes.fromhex(block_hash))
            if broken_at is None and block.chain_hash != chain_hash.hex():
                broken_at = position
            if block_hash != block.block_hash:
                claims[block_hash] = block.block_hash
                problems.append(_edited(path, f"block {position} of its chain", block.block_hash))
            chain.append(self._block(block, block_hash, chain_hash.hex()))
        if broken_at is not None and not claims:
            problems.append(
                f"{path}: the chain hash at block {broken_at} of its chain does not match the blocks up to it"
            )
        other_places = []
        for place, blocks in (
            ("its deque", export.blocks_to_be_committed),
            ("its reconcile stack", export.reconcile_stack),
        ):
            true_blocks = []
            for position, block in enumerate(blocks, 1):
                block_hash = self._hash(block)
                if block_hash != block.block_hash:
                    claims[block_hash] = block.block_hash
                    problems.append(_edited(path, f"block {position} of {place}", block.block_hash))
                true_blocks.append(self._block(block, block_hash, None))
            other_places.append(true_blocks)
        times = Counter(block.block_hash for blocks in (chain, *other_places) for block in blocks)
        problems += [
            f"{path}: it holds block {block_hash[:HASH_DIGITS]} {count} times"
            for block_hash, count in times.items()
            if count > 1
        ]
        parts = {
            "inception": true,
            "chain": chain,
            "blocks_to_be_committed": other_places[0],
            "reconcile_stack": other_places[1],
        }
        return ReadExport(path, export.model_copy(update=parts), problems, claims)

    def _hash(self, block: ExportedBlock) -> str:
        content = block.agent_id, block.timestamp_us, block.event_data
        block_hash = self._hashes.get(content)
        if block_hash is None:
            block_hash = self._hashes[content] = _computed_hash(block)
        return block_hash

    def _block(self, block: ExportedBlock, block_hash: str, chain_hash: str | None) -> ExportedBlock:
        key = block_hash, chain_hash
        shared = self._blocks.get(key)
        if shared is None:
            if (block.block_hash, block.chain_hash) != key:
                block = block.model_copy(update={"block_hash": block_hash, "chain_hash": chain_hash})
            shared = self._blocks[key] = block
        return shared


def _computed_hash(block: ExportedBlock) -> str:
    """Return the hash of a block (eq. 3.1). The function of hashlib is four times as fast as that of `ucp.block`."""
    return sha256(BLOCK_HEADER.pack(block.agent_id, block.timestamp_us) + a2b_base64(block.event_data)).hexdigest()


def _edited(path: Path, which: str, claimed: str) -> str:
    return f"{path}: {which} does not match its hash {claimed[:HASH_DIGITS]}: it was edited or damaged"


def _content(path: Path, named_by_user: bool) -> bytes:
    """Return the content of a file. Raises NotAnExportError if the file does not look like an export and the user did
    not name the file itself. Raises ExportError if the file cannot be read or is too large.
    """
    try:
        with BoundedFile(path, MAX_EXPORT_BYTES) as file:
            if not named_by_user and path.suffix != ".json" and _FORMAT not in file.peek(BEGINNING_BYTES):
                raise NotAnExportError(f"{path}: not a chain export")
            data = file.read()
            if file.problem and len(data) >= MAX_EXPORT_BYTES:
                raise ExportError(f"{path}: larger than {MAX_EXPORT_BYTES} bytes, which is too large for an export")
            return data
    except OSError as error:
        raise ExportError(f"{path}: cannot be read: {error.strerror}") from None


def _recover(path: Path, data: bytes, problems: list[str]) -> Export:
    """Return the undamaged parts of an export. Add a sentence to `problems` for each error."""
    if _FORMAT not in data:
        raise NotAnExportError(f"{path}: not a chain export")
    text = data.decode("utf-8", errors="replace")
    try:
        document = parse_json(text, strict=False)
    except ValueError as error:
        if not isinstance(error, json.JSONDecodeError):
            raise json_error(path, error) from None
        damage = error.pos
        document = _parse_prefix(text[:damage])
        if isinstance(document, dict):
            after = [*_intact_blocks(text[damage:])]
            before = document.get("chain")
            document["chain"] = [*(before if isinstance(before, list) else ()), *after]
        problems.append(
            f"{path}: cut off or damaged at {_place(text, damage)}: its undamaged part is used; {EXPORT_AGAIN}"
        )
    if not isinstance(document, dict):
        raise ExportError(f"{path}: no part of it is undamaged")
    if document.get("schema") != SCHEMA:
        schema = str(document.get("schema"))[:40]
        raise ExportError(f"{path}: its schema is {schema!r}, and this version reads {SCHEMA!r}")
    try:
        read, invalid_parts = validate_leniently(_PartialExport, document)
    except ValueError as error:
        raise ExportError(f"{path}: {error}") from None
    if not problems:
        problems += [f"{path}: {part}; the rest of it is used" for part in invalid_parts]
    if read.agent_id is None or read.inception is None:
        missing = "agent_id" if read.agent_id is None else "inception"
        raise ExportError(f"{path}: `{missing}` is missing or damaged, so its agent or its mission is unknown")
    completed = [block for block in read.completed if re.fullmatch("[0-9a-f]{64}", block)]
    return Export.model_construct(
        **{name: getattr(read, name) for name in type(read).model_fields if name != "completed"}, completed=completed
    )


_TOKEN = re.compile(r'"(?:[^"\\]|\\.|\\\Z)*(?:"|\Z)|[\[\]{},]', re.DOTALL)
"""A pattern for a JSON string or bracket. A truncated string extends to the end of the text, so brackets inside of it
do not count.
"""
_FLAT_OBJECT = re.compile(r"\{[^{}]*\}")


def _parse_prefix(text: str) -> Any:
    """Return the undamaged beginning of a truncated JSON value. Return None if no part of it is complete."""
    closing: list[str] = []
    complete_end, after = 0, ""
    for token in _TOKEN.finditer(text):
        match token[0]:
            case "{" | "[":
                closing.append("}" if token[0] == "{" else "]")
            case "}" | "]":
                closing.pop()
                complete_end, after = token.end(), "".join(reversed(closing))
            case ",":
                complete_end, after = token.start(), "".join(reversed(closing))
    try:
        return parse_json(text[:complete_end] + after, strict=False)
    except ValueError:
        return None


def _intact_blocks(text: str) -> Iterator[Any]:
    """Search a text for blocks, and yield each block whose hash is correct. The text between the blocks may be
    anything.
    """
    for candidate in _FLAT_OBJECT.finditer(text):
        try:
            block = ExportedBlock.model_validate_json(candidate[0])
        except ValidationError:
            continue
        if _computed_hash(block) == block.block_hash:
            yield block.model_dump()


def _place(text: str, position: int) -> str:
    return f"line {text.count(chr(10), 0, position) + 1} of {text.count(chr(10)) + 1}"


def all_blocks(read_exports: Iterable[ReadExport]) -> dict[str, ExportedBlock]:
    """Return every block of all exports, by block hash."""
    return {block.block_hash: block for each in read_exports for block in each.export.blocks()}
