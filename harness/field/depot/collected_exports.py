"""Reads the chain exports that came home, whatever has become of them: all that is usable of each is used.

An export that was cut off is read up to there, and of one that was edited or damaged the parts that are whole. A block
is what it hashes to (eq. 3.1), not what the file says that it hashes to; where the two differ it is told. Blocks that
many vehicles hold are kept once.
"""

import base64
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

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
)
from harness.archive.record_file import validate_leniently
from harness.archive.traces import read_trace
from harness.archive.vocabulary import unknown_names
from harness.errors import ExportError
from harness.field.depot.mission_comparison import INCEPTION, ROSTER, Carried, UnreadableFileError
from harness.field.depot.mission_comparison import read as read_carried
from harness.field.ingest import LeftOut
from harness.field.ingest._file_search import files_of
from harness.gc_pause import gc_paused
from harness.report.logbook.book import logged_telemetry
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.export import SCHEMA

HASH_DIGITS = 12
NAMED_AT_MOST = 5
BEGINNING_BYTES = 4096
_FORMAT = SCHEMA.partition("/")[0].encode()
AGAIN = "export it again if you can"


@dataclass(frozen=True)
class Brought:
    """An export, its hashes made true, and the file that it was in.

    `problems` are sentences on what is wrong with it. `claims` has of the blocks that are not what the file says which
    hash it gives them: the true one, and the claimed.
    """

    path: Path
    export: Export
    problems: list[str]
    claims: dict[str, str]

    def blocks(self) -> set[str]:
        """The hashes of all blocks that it has."""
        return {block.block_hash for block in self.export.blocks()}


@dataclass
class CameHome:
    """The exports of one mission: of each agent the latest, and those before.

    `left_out` are sentences on files that are not used, and `remarks` on what must be known of those that are, without
    being wrong.
    """

    latest: dict[int, Brought]
    earlier: list[Brought]
    left_out: list[str]
    remarks: list[str]
    roster: set[int] = field(default_factory=set)
    """Agents that mission files, traces, a manifest or a run's record beside the exports name."""
    traced: dict[int, list[str]] = field(default_factory=dict)
    """Hashes of the blocks that agents without an export completed, by their traces."""
    telemetry: bool = True
    """Whether events are those of vehicles, as far as anything says otherwise."""

    @property
    def brought(self) -> list[Brought]:
        return [*self.latest.values(), *self.earlier]

    @property
    def exports(self) -> dict[int, Export]:
        """The latest of each agent."""
        return {agent_id: brought.export for agent_id, brought in self.latest.items()}

    @property
    def inception(self) -> ExportedInception:
        return next(iter(self.latest.values())).export.inception

    @property
    def problems(self) -> list[str]:
        return [problem for brought in self.brought for problem in brought.problems]

    @property
    def claims(self) -> dict[str, str]:
        """Of the blocks that are nowhere what a file says: the true hash, and the claimed one.

        A block that another export has under its own hash, or that its agent completed, is good.
        """
        claims = {true: claimed for brought in self.brought for true, claimed in brought.claims.items()}
        for brought in self.brought if claims else ():
            for good in {*brought.export.completed, *(brought.blocks() - brought.claims.keys())}:
                claims.pop(good, None)
        return claims


@gc_paused()
def came_home(paths: Iterable[Path]) -> CameHome:
    """What the files, and those in directories, hold of the mission that most of them are of.

    Raises FieldError if a path does not exist, and ExportError if nothing in them is usable.
    """
    reader, brought, left_out = _Reader(), list[Brought](), list[str]()
    passed_over, beside = list[LeftOut](), list[Carried]()
    paths = list(paths)
    for path in files_of(paths, passed_over):
        named = path in paths or path.name.endswith(SUFFIX)
        try:
            brought.append(reader.read(path, named=named))
        except NotAnExportError as error:
            try:
                beside.append(read_carried(path))
            except UnreadableFileError:
                left_out += [str(error)] if named else []
        except ExportError as error:
            left_out.append(str(error))
    if not brought:
        why = left_out[0] if left_out else "no file contains a chain export"
        more = f" (and {len(left_out) - 1} files more)" if len(left_out) > 1 else ""
        raise ExportError(f"none of these files is usable: {why}{more}")
    mission = _largest_mission(brought)
    left_out += _of_other_missions(brought, mission)
    home = _by_agent([each for each in brought if each.export.inception.block_hash == mission], left_out)
    home.remarks += [each.sentence for each in passed_over]
    _look_beside(home, [each for each in beside if each.shared[INCEPTION].value == mission])
    return home


def _look_beside(home: CameHome, carried: Iterable[Carried]) -> None:
    """Who flew, and what their events are, as other files of the mission say it."""
    for each in carried:
        if each.kind == "trace" and each.agent_id is not None and each.agent_id not in home.latest:
            trace = read_trace(each.path, skim=True)
            home.traced.setdefault(each.agent_id, []).extend(trace.completed() if trace else ())
            if unknown := unknown_names(trace.runs if trace else ()).get("operation"):
                home.remarks.append(
                    f"{each.path}: {unknown}, so the completed blocks of agent {each.agent_id} are unknown"
                )
        if ROSTER in each.shared:
            home.roster.update(each.shared[ROSTER].value)  # type: ignore[arg-type]
        if each.mission is not None and each.mission.events.source == "random":
            home.telemetry = False
    around = (directory for brought in home.brought for directory in (brought.path.parent, brought.path.parent.parent))
    run = next((directory for directory in dict.fromkeys(around) if (directory / RUN_FILE).is_file()), None)
    if run is not None:
        record = RunArchive(run).record
        home.roster.update(record.known_agents)
        home.telemetry = logged_telemetry(record)


class NotAnExportError(ExportError):
    """A file of something else."""


def _largest_mission(brought: Iterable[Brought]) -> str:
    """The inception block of most agents; of several that with more blocks, else the first."""
    agents: dict[str, set[int]] = {}
    blocks: Counter[str] = Counter()
    for each in brought:
        mission = each.export.inception.block_hash
        agents.setdefault(mission, set()).add(each.export.agent_id)
        blocks[mission] += len(each.export.chain)
    return max(agents, key=lambda mission: (len(agents[mission]), blocks[mission]))


def _of_other_missions(brought: Iterable[Brought], mission: str) -> Iterator[str]:
    others: dict[str, list[Path]] = {}
    for each in brought:
        if each.export.inception.block_hash != mission:
            others.setdefault(each.export.inception.block_hash, []).append(each.path)
    for other, files in others.items():
        names = ", ".join(map(str, files[:NAMED_AT_MOST]))
        more = f" and {len(files) - NAMED_AT_MOST} more" if len(files) > NAMED_AT_MOST else ""
        are = "are" if len(files) > 1 else "is"
        yield (
            f"{names}{more}: {are} of another mission (inception block {other[:HASH_DIGITS]}, not "
            f"{mission[:HASH_DIGITS]}); consolidate {'them by themselves' if len(files) > 1 else 'it by itself'}"
        )


def _by_agent(brought: Iterable[Brought], left_out: list[str]) -> CameHome:
    """Of several exports of an agent the latest is what it holds; what the others hold besides came home as well."""
    home = CameHome({}, [], left_out, [])
    for each in brought:
        agent_id = each.export.agent_id
        other = home.latest.get(agent_id)
        if other is None:
            home.latest[agent_id] = each
            continue
        if other.export == each.export:
            home.remarks.append(f"{each.path}: the same export as {other.path}, counted once")
            continue
        age = each.export.exported_at_us, len(each.export.completed), len(each.export.chain)
        its_age = other.export.exported_at_us, len(other.export.completed), len(other.export.chain)
        earlier, home.latest[agent_id] = (other, each) if age >= its_age else (each, other)
        home.earlier.append(earlier)
        home.remarks.append(
            f"{earlier.path}: agent {agent_id} exported its chain again later, in {home.latest[agent_id].path}: the "
            "later export is current; the earlier one is recorded as well"
        )
    home.latest = dict(sorted(home.latest.items()))
    return home


# A file


class _Damaged(Export):
    """What can be read of an export by itself."""

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


class _Reader:
    """Reads exports one after another. What they share is made once."""

    def __init__(self) -> None:
        self._hashes: dict[tuple[int, int, str], str] = {}
        self._blocks: dict[tuple[str, str | None], ExportedBlock] = {}

    def read(self, path: Path, *, named: bool) -> Brought:
        """Raises ExportError: why nothing of it can be used, or NotAnExportError for a file of something else."""
        data = _content(path, named)
        problems: list[str] = []
        try:
            export = Export.model_validate_json(data)
        except ValidationError:
            export = _what_is_whole(path, data, problems)
        return self._made_true(path, export, problems)

    def _made_true(self, path: Path, export: Export, problems: list[str]) -> Brought:
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
        aside = []
        for place, blocks in (
            ("its deque", export.blocks_to_be_committed),
            ("its reconcile stack", export.reconcile_stack),
        ):
            made = []
            for position, block in enumerate(blocks, 1):
                block_hash = self._hash(block)
                if block_hash != block.block_hash:
                    claims[block_hash] = block.block_hash
                    problems.append(_edited(path, f"block {position} of {place}", block.block_hash))
                made.append(self._block(block, block_hash, None))
            aside.append(made)
        times = Counter(block.block_hash for blocks in (chain, *aside) for block in blocks)
        problems += [
            f"{path}: it holds block {block_hash[:HASH_DIGITS]} {count} times"
            for block_hash, count in times.items()
            if count > 1
        ]
        parts = {"inception": true, "chain": chain, "blocks_to_be_committed": aside[0], "reconcile_stack": aside[1]}
        return Brought(path, export.model_copy(update=parts), problems, claims)

    def _hash(self, block: ExportedBlock) -> str:
        content = block.agent_id, block.timestamp_us, block.event_data
        block_hash = self._hashes.get(content)
        if block_hash is None:
            block_hash = Block(block.agent_id, block.timestamp_us, block.event_bytes).block_hash.hex()
            self._hashes[content] = block_hash
        return block_hash

    def _block(self, block: ExportedBlock, block_hash: str, chain_hash: str | None) -> ExportedBlock:
        key = block_hash, chain_hash
        kept = self._blocks.get(key)
        if kept is None:
            if (block.block_hash, block.chain_hash) != key:
                block = block.model_copy(update={"block_hash": block_hash, "chain_hash": chain_hash})
            kept = self._blocks[key] = block
        return kept


def _edited(path: Path, which: str, claimed: str) -> str:
    return f"{path}: {which} does not match its hash {claimed[:HASH_DIGITS]}: it was edited or damaged"


def _content(path: Path, named: bool) -> bytes:
    """What is in a file, if it was named, is called as exports are, or begins as one."""
    try:
        with BoundedFile(path, MAX_EXPORT_BYTES) as file:
            if not named and path.suffix != ".json" and _FORMAT not in file.peek(BEGINNING_BYTES):
                raise NotAnExportError(f"{path}: not a chain export")
            data = file.read()
            if file.problem and len(data) >= MAX_EXPORT_BYTES:
                raise ExportError(f"{path}: larger than {MAX_EXPORT_BYTES} bytes, which is too large for an export")
            return data
    except OSError as error:
        raise ExportError(f"{path}: cannot be read: {error.strerror}") from None


def _what_is_whole(path: Path, data: bytes, problems: list[str]) -> Export:
    """The parts of a damaged export that are whole; what is wrong with the others is told in `problems`."""
    if _FORMAT not in data:
        raise NotAnExportError(f"{path}: not a chain export")
    text = data.decode("utf-8", errors="replace")
    try:
        document = json.loads(text, strict=False)
    except (ValueError, RecursionError) as error:
        damage = error.pos if isinstance(error, json.JSONDecodeError) else 0
        document = _up_to(text[:damage])
        if isinstance(document, dict):
            after = [*_whole_blocks(text[damage:])]
            before = document.get("chain")
            document["chain"] = [*(before if isinstance(before, list) else ()), *after]
        problems.append(f"{path}: cut off or damaged at {_place(text, damage)}: its undamaged part is used; {AGAIN}")
    if not isinstance(document, dict):
        raise ExportError(f"{path}: no part of it is undamaged")
    if document.get("schema") != SCHEMA:
        said = str(document.get("schema"))[:40]
        raise ExportError(f"{path}: its schema is {said!r}, and this version reads {SCHEMA!r}")
    try:
        read, invalid_parts = validate_leniently(_Damaged, document)
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
"""A string that the text breaks off in goes to its end, whatever brackets are in it."""
_FLAT_OBJECT = re.compile(r"\{[^{}]*\}")


def _up_to(text: str) -> Any:
    """The JSON value of which a text is the beginning, with all that is whole in it; None if there is nothing."""
    closing: list[str] = []
    whole, after = 0, ""
    for token in _TOKEN.finditer(text):
        match token[0]:
            case "{" | "[":
                closing.append("}" if token[0] == "{" else "]")
            case "}" | "]":
                closing.pop()
                whole, after = token.end(), "".join(reversed(closing))
            case ",":
                whole, after = token.start(), "".join(reversed(closing))
    try:
        return json.loads(text[:whole] + after, strict=False)
    except (ValueError, RecursionError):
        return None


def _whole_blocks(text: str) -> Iterator[Any]:
    """The blocks that stand in a text, whatever stands around them, and are what they hash to."""
    for candidate in _FLAT_OBJECT.finditer(text):
        try:
            block = ExportedBlock.model_validate_json(candidate[0])
        except ValidationError:
            continue
        if Block(block.agent_id, block.timestamp_us, block.event_bytes).block_hash.hex() == block.block_hash:
            yield block.model_dump()


def _place(text: str, position: int) -> str:
    return f"line {text.count(chr(10), 0, position) + 1} of {text.count(chr(10)) + 1}"


def all_blocks(brought: Iterable[Brought]) -> dict[str, ExportedBlock]:
    """Every block that anybody holds, by hash."""
    return {block.block_hash: block for each in brought for block in each.export.blocks()}
