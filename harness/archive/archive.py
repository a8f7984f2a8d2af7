"""Read the files of a run or of a real flight. The files may be complete or damaged.

Checker, report and all other commands read runs through this module. It reads each file once, at its first use.
Unusable data is omitted. `problems` contains a sentence for each damaged or wrong file. `gaps` contains a sentence for
each missing file that a complete run would have.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from harness.archive.bounded_file import JsonLines, Record
from harness.archive.connectivity import NETWORK_FILE, Connectivity, Link, read_connectivity, read_link_losses
from harness.archive.directory import PUBLIC_KEYS_FILE, ROGUE_FILE
from harness.archive.exports import (
    BEFORE_FINAL_RECONCILE,
    RUN_FILE,
    Export,
    ExportedBlock,
    Exports,
    agents_directory,
    export_files,
    export_paths,
    read_exports,
)
from harness.archive.history import has_possible_time
from harness.archive.record_file import RecordFile, read_record
from harness.archive.run_journals import CHANNEL_FILE, LAG_FILE, ChannelLine, LagLine, MeasuredLag
from harness.archive.run_record import AgentRecord, JudgedRecord, RunRecord
from harness.archive.trace_files import MAX_TRACE_BYTES, is_packed, trace_file, trace_files
from harness.archive.traces import HandlerRunLine, Trace, read_clock, read_trace, read_trace_lines, why_not_a_trace
from harness.archive.tracks import TRACKS_FILE, VehicleTracks, read_tracks
from harness.errors import RunDirectoryError
from ucp.trace import HandlerRun

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys

LARGE_BYTES = 16 * 1024 * 1024
"""Size of all traces of a run together, in bytes. If the traces are larger and the caller allows it, the reader omits
handler runs that only received a message.
"""
_AGENT_ID = re.compile("[1-9][0-9]{0,4}")

ReportProgress = Callable[[str], None]
"""The type of a function that receives the current step of a long job as text, such as "reading trace 3 of 50"."""


class RecordedRun(NamedTuple):
    """A handler run in a trace. `agent_id` is the ID of the agent that ran the handler. `life` is the number of the
    agent's incarnation: 1 until its first restart, then 2, and so on. `line` is the line number in the trace, counted
    from 1.
    """

    agent_id: int
    life: int
    line: int
    run: HandlerRun


class HeldBlock(NamedTuple):
    """A block that the agent `holder` holds in its `chain`, its `deque` or its reconcile `stack`.

    `position` is the position of the block, counted from 0. In a chain, the oldest block has position 0, and the
    inception block is not counted.
    """

    holder: int
    place: str
    position: int
    block: ExportedBlock


class RunArchive:
    """The files of a run, read from run directories, directories of exports, or single export files.

    The object reads each file once, at its first use. `directory` is the first given directory that has a run.json,
    otherwise the first given directory. It is None if the caller names only files.

    - `skim`: if true, omit from large traces the handler runs that only received a message.
    - `keys`: public keys that the user trusts. The object uses them instead of the keys in the directory.
    - `traces`: the traces by agent, if the caller has them in memory. The object then reads no trace files.
    - `report_progress`: a function that receives a text before each long step of reading and judging.

    Raises RunDirectoryError if a path does not exist, or is a directory with other content.
    """

    def __init__(
        self,
        *given: Path | str,
        skim: bool = False,
        keys: "PublicKeys | None" = None,
        traces: dict[int, Trace] | None = None,
        report_progress: ReportProgress = lambda step: None,
    ) -> None:
        self.report_progress = report_progress
        paths = [Path(path) for path in given]
        self._trusted_keys = keys
        self._export_files = export_files(paths)
        self._skim = skim
        self._given_traces = traces
        directories = [path for path in paths if path.is_dir()]
        recorded = (path for path in directories if (path / RUN_FILE).exists())
        self.directory = next(recorded, directories[0] if directories else None)
        beside = [path.parent for path in self._export_files]
        # A directory may have traces and no exports: the run was killed.
        self._agents = list(dict.fromkeys([*beside, *map(agents_directory, directories)]))

    # The record of the run

    @property
    def recorded(self) -> bool:
        """True if the file run.json exists and at least a part of it can be read."""
        return self._record_file is not None and self._record_file.error is None

    @property
    def record(self) -> RunRecord:
        """The readable content of run.json. The field of a missing or damaged part is empty."""
        return self._record_file.record if self._record_file else RunRecord()

    @property
    def judged_record(self) -> JudgedRecord | None:
        """The part of run.json that the checker needs. None if any key of this part is missing or damaged."""
        return self._record_file.judged if self._record_file else None

    @property
    def record_error(self) -> RunDirectoryError | None:
        """The reason why no part of the existing run.json can be read. None if the file does not exist, or if at least
        a part of it can be read.
        """
        return self._record_file.error if self._record_file else None

    @property
    def record_problems(self) -> list[str]:
        """A sentence for each error in run.json. Errors in keys that the checker needs come first."""
        return self._record_file.problems if self._record_file else []

    @cached_property
    def origin(self) -> RunRecord:
        """The content of the run.json that belongs to the exports. The object also finds this file if the user named
        only single files of the run directory.
        """
        if self.directory is not None:
            return self.record
        beside = dict.fromkeys(path.parent for file in self._export_files for path in (file.parent, file))
        return next((RunArchive(path).record for path in beside if (path / RUN_FILE).is_file()), RunRecord())

    @cached_property
    def _record_file(self) -> RecordFile | None:
        path = self._in_directory(RUN_FILE)
        return read_record(path) if path is not None and path.exists() else None

    @cached_property
    def roster(self) -> list[int]:
        """The IDs of the agents according to run.json. Without run.json, the IDs of the agents that left files."""
        names = (path.name.partition(".")[0] for directory in self._agents for path in directory.glob("*.*.json*"))
        return self.record.known_agents or sorted({int(name) for name in names if _AGENT_ID.fullmatch(name)})

    def forget_record(self) -> None:
        """Forget the stored content of run.json after this file was rewritten. The next access reads the file again."""
        for name in ("_record_file", "origin", "roster"):
            self.__dict__.pop(name, None)

    # Files of the agents

    @cached_property
    def exports(self) -> Exports:
        """The chain exports by agent. `errors` contains a sentence for each unusable file."""
        return read_exports(self._export_files)

    @cached_property
    def before_final_reconcile(self) -> dict[int, Export]:
        """The chain exports from before the final reconcile, by agent. Empty if the run had no final reconcile."""
        return self._before_final_reconcile.by_agent

    @cached_property
    def _before_final_reconcile(self) -> Exports:
        runs = dict.fromkeys(path.parent.parent for path in self._export_files)
        return read_exports(path for run in runs for path in export_paths(run / BEFORE_FINAL_RECONCILE))

    @cached_property
    def traces(self) -> dict[int, Trace]:
        """The trace of each agent, in order of agent IDs. The first access loads all traces into memory."""
        return self._read_traces[0]

    def trace_lines(self, agent_id: int) -> Iterator[HandlerRunLine]:
        """Yield the lines with handler runs in the trace of an agent. Raises RunDirectoryError if a line is damaged."""
        assert self.directory is not None
        return read_trace_lines(trace_file(agents_directory(self.directory), agent_id))

    def handler_runs(self) -> Iterator[RecordedRun]:
        """Yield every handler run, trace by trace, in order of agent IDs.

        The method reads traces line by line and does not store them, so it needs little memory for traces of any
        length. Raises RunDirectoryError at the first damaged line. The property `traces` also contains the handler runs
        before the damaged line.
        """
        for path in self._trace_files:
            for line in read_trace_lines(path):
                yield RecordedRun(line.agent_id, line.incarnation, line.number, line.parse())

    def blocks(self) -> Iterator[HeldBlock]:
        """Yield every block that an agent holds in its export, in order of agent IDs.

        The property `problems` contains a sentence for each export that cannot be read.
        """
        for agent_id, export in self.exports.by_agent.items():
            places = {"chain": export.chain, "deque": export.blocks_to_be_committed, "stack": export.reconcile_stack}
            for place, blocks in places.items():
                for position, block in enumerate(blocks):
                    yield HeldBlock(agent_id, place, position, block)

    @cached_property
    def epoch_us(self) -> int | None:
        """The timestamp of mission second 0, in microseconds, on which most trace headers agree. None if no header can
        be read.
        """
        epochs = Counter(
            epoch for path in self._trace_files if type(epoch := read_clock(path).get("epoch_us")) is int
        ).most_common(1)
        return epochs[0][0] if epochs else None

    @cached_property
    def large(self) -> bool:
        """True if all traces together are larger than LARGE_BYTES, or if any trace is packed."""
        files = [path for path in self._trace_files if path.is_file()]
        return any(map(is_packed, files)) or sum(path.stat().st_size for path in files) > LARGE_BYTES

    @cached_property
    def _trace_files(self) -> list[Path]:
        paths = [path for directory in self._agents for path in trace_files(directory)]
        return sorted(paths, key=lambda path: (len(path.name), path.name))

    @property
    def _never_began(self) -> bool:
        """True if the mission may have ended before mission second 0."""
        return self.record.outcome in ("not supported", "failed")

    @cached_property
    def _read_traces(self) -> tuple[dict[int, Trace], list[str], list[str]]:
        """Return the traces, and sentences about their problems and gaps."""
        if self._given_traces is not None:
            return self._given_traces, [], []
        traces: dict[int, Trace] = {}
        problems, gaps = [], []
        skim = self._skim and self.large
        known_agents = self.record.known_agents  # none without a record, as for exports from the field
        for number, path in enumerate(self._trace_files, 1):
            self.report_progress(f"reading trace {number} of {len(self._trace_files)}")
            if path.is_file() and path.stat().st_size > MAX_TRACE_BYTES:
                problems.append(
                    f"{path}: larger than {MAX_TRACE_BYTES} bytes, which is too large for a trace; it is left out"
                )
                continue
            trace = read_trace(path, skim=skim)
            if trace is None and self._never_began and not path.stat().st_size:
                continue  # an agent that was ready, but whose mission did not start
            if trace is None:
                problems.append(f"{path}: {why_not_a_trace(path)}; it is left out")
                continue
            agent_id = trace.header.agent_id
            if agent_id in traces or (known_agents and agent_id not in known_agents):
                problems.append(f"{path}: its agent is not in this run, or has another trace; it is left out")
                continue
            recorded = self.record.agents.get(str(agent_id))
            if recorded is not None and recorded.trace_problem:
                trace.problem = _early_end(trace, recorded)
            if trace.problem:
                problems.append(f"{path}: {trace.problem}; the part before is read")
            elif trace.cut_off:
                gaps.append(f"{path}: truncated in the middle of a line; the part before is read")
            if not all(map(has_possible_time, trace.runs)):
                gaps.append(f"{path}: handler runs without a possible time are left out of the timeline")
            traces[agent_id] = trace
        return dict(sorted(traces.items())), problems, gaps

    @cached_property
    def public_keys(self) -> "PublicKeys | None":
        """The public keys of a secured mission. None if the files contain no usable keys."""
        return self._public_keys[0]

    @cached_property
    def _public_keys(self) -> tuple["PublicKeys | None", list[str]]:
        """Return the public keys of the mission, and a sentence about each problem with them."""
        if self._trusted_keys is not None:
            return self._trusted_keys, []
        beside = [*([self.directory] if self.directory else []), *self._agents]
        path = next((place / PUBLIC_KEYS_FILE for place in beside if (place / PUBLIC_KEYS_FILE).exists()), None)
        if path is None:
            secured = self.record.scenario is not None and self.record.scenario.security is not None
            missing = (
                f"{PUBLIC_KEYS_FILE} is missing, although the run was secured: signatures of blocks are not checked"
            )
            return None, [missing] if secured and not self._never_began else []
        try:
            from ucp.secure.bundle import load_public
            from ucp.secure.keyfile import KeyFileError
        except ModuleNotFoundError:
            return None, [f"{path}: signatures are not checked without the package cryptography (extra `secure`)"]
        try:
            return load_public(path), []
        except KeyFileError as error:
            return None, [f"{error}; signatures of blocks are not checked"]

    @property
    def anchor(self) -> str | None:
        """The source that confirms the public keys: `--keys` if the user gave keys, or run.json if it contains the
        fingerprint of the keys. None if neither confirms the keys.
        """
        if self._trusted_keys is not None:
            return "--keys"
        keys = self.public_keys
        return RUN_FILE if keys is not None and keys.fingerprint == self.record.keys_fingerprint else None

    @property
    def stores(self) -> dict[int, Path]:
        """The store file of each agent with a disk, by agent ID. For a restarted agent, this is the file of its last
        incarnation.
        """
        if self.directory is None:
            return {}
        agents = agents_directory(self.directory)
        by_incarnation: dict[int, dict[int, Path]] = defaultdict(dict)
        for path in (*agents.glob("*.store"), *agents.glob("*-*/*.store")):
            agent, _, incarnation = path.parent.name.partition("-") if path.parent != agents else (path.stem, "", "1")
            if agent == path.stem and _AGENT_ID.fullmatch(agent) and _AGENT_ID.fullmatch(incarnation):
                by_incarnation[int(agent)][int(incarnation)] = path
        return {agent_id: paths[max(paths)] for agent_id, paths in by_incarnation.items()}

    # Network, vehicles and the rogue node

    def network(self, vehicles: Collection[int]) -> Connectivity:
        """Return the connections between vehicles at each time. The result is empty if the network was not recorded."""
        return read_connectivity(self._in_directory(NETWORK_FILE), vehicles)

    def link_losses(self, vehicles: Collection[int]) -> Iterator[tuple[float, dict[Link, float]]]:
        """Yield mission seconds with the loss rates (0 to 1) of links. The first entry contains all links. Each later
        entry contains the links whose loss rate changed.
        """
        return read_link_losses(self._in_directory(NETWORK_FILE), vehicles)

    def tracks(self, vehicles: Collection[int]) -> VehicleTracks:
        """Return the positions of the vehicles over time."""
        return read_tracks(self._in_directory(TRACKS_FILE), vehicles)

    def injected(self, model: type[Record]) -> Iterable[Record]:
        """Return the datagrams that the rogue node sent, each as an object of type `model`."""
        return JsonLines(self._in_directory(ROGUE_FILE), model)

    def conditions(self, model: type[Record]) -> list[Record] | None:
        """Return the recorded network changes and faults, each as an object of type `model`. Return None if they were
        not recorded.
        """
        path = self._in_directory(NETWORK_FILE)
        return [*JsonLines(path, model)] if path is not None and path.is_file() else None

    def channel(self) -> list[ChannelLine] | None:
        """Return the log of the shared radio channel. Return None if there is no such log."""
        path = self._in_directory(CHANNEL_FILE)
        return [*JsonLines(path, ChannelLine)] if path is not None and path.is_file() else None

    def lag(self) -> MeasuredLag | None:
        """Return the measured delays of the machine and the agents. Return None if they were not measured."""
        path = self._in_directory(LAG_FILE)
        lines = [*JsonLines(path, LagLine)] if path is not None and path.is_file() else []
        return MeasuredLag(lines) if lines else None

    # Damaged and missing files

    @property
    def problems(self) -> list[str]:
        """A sentence for each damaged or unusable file, with the name of the file."""
        before = self._before_final_reconcile.errors
        return [*self.record_problems, *self._read_traces[1], *self._public_keys[1], *self.exports.errors, *before]

    @property
    def gaps(self) -> list[str]:
        """A sentence for each file of a complete run that is missing or truncated."""
        return [*self._read_traces[2], *self._missing()]

    def _missing(self) -> Iterator[str]:
        if self.directory is None:
            return
        if not (self.directory / RUN_FILE).exists():
            yield f"{RUN_FILE} is missing: scenario, verdict and figures are unknown"
        agents_without_trace = [agent_id for agent_id in self.roster if agent_id not in self.traces]
        if agents_without_trace and not self.traces:
            yield "no agent has a trace: there is no timeline"
        else:
            yield from (
                f"agent {agent_id}: no trace, and so no lane in the timeline" for agent_id in agents_without_trace
            )
        if not (self.directory / NETWORK_FILE).is_file():
            yield f"{NETWORK_FILE} is missing: the network conditions are unknown"
        vehicles_flew = self.record.vehicles or (self.record.scenario and self.record.scenario.flight)
        if vehicles_flew and not (self.directory / TRACKS_FILE).is_file():
            yield f"{TRACKS_FILE} is missing: the positions of the vehicles are unknown"

    def within(self, sentence: str) -> str:
        """Return the sentence with file names relative to the run directory."""
        return sentence if self.directory is None else sentence.replace(f"{self.directory}{os.sep}", "")

    def _in_directory(self, name: str) -> Path | None:
        return None if self.directory is None else self.directory / name


def _early_end(trace: Trace, recorded: AgentRecord) -> str:
    """Return a sentence about a trace that ends early because the agent could not write the rest."""
    why = f"it ends early: {recorded.trace_problem}"
    counted = [life.counted if life else None for life in recorded.handler_runs]
    if not trace.runs or None in counted:
        return why
    missing = sum(number or 0 for number in counted) - len(trace.runs)
    return f"{why}; {missing} handler runs after {trace.runs[-1].t:.0f} s are not recorded" if missing > 0 else why
