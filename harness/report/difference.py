"""Compare two run directories: the keys of their scenarios, their traces, and their exported chains. Find the first
handler run of an agent that occurs in only one of the runs.

Runs are compared agent by agent and handler run by handler run. The comparison covers incarnation, handler, branch,
trigger with the message number, sent messages, and changes of chain, deque and stack. Blocks are compared by name, such
as 4.11, because hashes depend on timestamps. Times are not compared, because they differ between any two runs of
processes. The state after a handler run is not compared, because it follows from the changes. The exported chains are
compared block by block.

In virtual time, the same seed and scenario give identical traces. Runs of processes soon differ even without an error,
because the kernel decides which of two messages arrives first. The first difference is still a good place to start an
analysis.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE
from harness.archive.traces import HandlerRunLine
from harness.errors import RunDirectoryError
from harness.report.agent_programs import AgentProgram, programs
from harness.report.chain_tree import ranges
from ucp.trigger import Trigger


@dataclass(frozen=True)
class ComparedStep:
    """A handler run in the form in which two runs are compared. The comparison ignores the mission second `t` and the
    line number `line`.

    `changes` contains pairs (operation, block), and `sent` contains pairs (message, block). In these pairs, a block is
    represented by its name, such as 4.11. The block is None for messages that concern no block.
    """

    life: int
    handler: str
    branch: str
    trigger: Trigger
    changes: tuple[tuple[str, str], ...]
    sent: tuple[tuple[str, str | None], ...]
    t: float = field(compare=False)
    line: int = field(compare=False)

    @classmethod
    def of(cls, line: HandlerRunLine, names: Mapping[str, str]) -> "ComparedStep":
        """Return a trace line in the form that is compared. `names` maps the hashes of blocks to names. A block without
        a name is represented by the first 12 digits of its hash.
        """
        run = line.parse()
        return cls(
            line.incarnation,
            run.handler,
            run.branch,
            run.trigger,
            tuple((operation, name(block, names)) for operation, block in run.changes),
            tuple((sent.message, sent.block and name(sent.block, names)) for sent in run.sent),
            run.t,
            line.number,
        )


def name(block_hash: str, names: Mapping[str, str]) -> str:
    return names.get(block_hash, block_hash[:12])


def completed_blocks(lines: Iterable[HandlerRunLine], agent_id: int) -> dict[str, str]:
    """Return the names of the blocks that the agent completed, such as 3.2, by block hash."""
    names: dict[str, str] = {}
    for line in lines:
        if b'"complete"' in line.text:
            for operation, block in line.parse().changes:
                if operation == "complete":
                    names.setdefault(block, f"{agent_id}.{len(names) + 1}")
    return names


@dataclass(frozen=True)
class KeyDifference:
    """A scenario key, such as `network.loss` or `timeline.0.at_s`, whose value differs between the two runs. If the
    scenario of a run does not contain the key, the value for this run is None.
    """

    key: str
    a: Any
    b: Any


def differing_keys(a: Any, b: Any, key: str = "") -> Iterator[KeyDifference]:
    """Yield each scenario key whose value differs, in the order of `a`. For nested values, yield the innermost key that
    differs. For two lists with different lengths, yield only the key of the list.
    """
    if isinstance(a, dict) and isinstance(b, dict):
        pairs = [(name, a.get(name), b.get(name)) for name in {**a, **b}]
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        pairs = [(index, value_a, value_b) for index, (value_a, value_b) in enumerate(zip(a, b, strict=True))]
    else:
        if a != b:
            yield KeyDifference(key, a, b)
        return
    for name, value_a, value_b in pairs:
        yield from differing_keys(value_a, value_b, f"{key}.{name}" if key else str(name))


@dataclass(frozen=True)
class FirstDifference:
    """The first position at which the two traces of an agent differ, and the two different handler runs at this
    position. If one trace has already ended, its handler run is None.
    """

    number: int
    a: ComparedStep | None
    b: ComparedStep | None

    @property
    def at_s(self) -> float:
        """The mission second of the earlier of the two handler runs that differ."""
        return min(step.t for step in (self.a, self.b) if step is not None)


@dataclass(frozen=True)
class ChainDifference:
    """The first position (from 1) at which the two exported chains of an agent differ, and the names of the two
    different blocks at this position. If one chain has already ended, its block name is None. If an agent has no
    export, its chain counts as empty.
    """

    place: int
    a: str | None
    b: str | None


@dataclass(frozen=True)
class AgentDifference:
    run: FirstDifference | None
    chain: ChainDifference | None


@dataclass(frozen=True)
class RunDifference:
    """All differences between two runs."""

    keys: list[KeyDifference]
    """The scenario keys whose values differ between the two runs. The seed of the run counts as the key `seed`."""
    programs: dict[Literal["a", "b"], list[AgentProgram]]
    """The programs of the agents in each run. The list of a run is empty if all agents ran the harness's own program.
    """
    agents: dict[int, AgentDifference]
    """An entry for every agent of the mission. In the entry of an agent without a difference, both fields are None."""
    handler_runs: int
    """The number of equal handler runs, added over all agents. For each agent, only handler runs before its first
    difference count.
    """
    exact: bool
    """True if the traces are equal to the last byte."""
    errors: list[str]
    """A sentence for each unusable export, and for each run whose end is not recorded."""

    @property
    def first(self) -> int | None:
        """The agent whose first difference has the earliest mission time. Of several such agents, it is the one with
        the lowest ID. None if there are no differences.
        """
        at_s = {
            agent_id: difference.run.at_s for agent_id, difference in self.agents.items() if difference.run is not None
        }
        return min(at_s, key=lambda agent_id: (at_s[agent_id], agent_id), default=None)

    @property
    def verdict(self) -> str:
        """The verdict: `identical`, `same but for times`, or `differ`. Different scenario keys do not affect the
        verdict.
        """
        if any(difference.run or difference.chain for difference in self.agents.values()):
            return "differ"
        return "identical" if self.exact else "same but for times"

    def to_json(self) -> dict[str, object]:
        return {
            "verdict": self.verdict,
            "keys": [asdict(key) for key in self.keys],
            "programs": {run: [program.to_json() for program in ran] for run, ran in self.programs.items()},
            "first": self.first,
            "handler_runs": self.handler_runs,
            "agents": {str(agent_id): asdict(difference) for agent_id, difference in self.agents.items()},
            "errors": self.errors,
        }


def compare(a: Path, b: Path) -> RunDifference:
    """Return the differences between two run directories. Raises RunDirectoryError if a directory contains no run, or
    if the two runs have different agents or different backends.
    """
    run_a, run_b = _ComparedRun(a), _ComparedRun(b)
    _check_comparable(run_a, run_b)
    agents: dict[int, AgentDifference] = {}
    handler_runs, exact = 0, True
    for agent_id in run_a.roster:
        equal, to_the_byte, first_difference = _compare_traces(run_a, run_b, agent_id)
        handler_runs, exact = handler_runs + equal, exact and to_the_byte
        chains = _compare_chains(run_a.chain(agent_id), run_b.chain(agent_id))
        agents[agent_id] = AgentDifference(first_difference, chains)
    keys = [*differing_keys(run_a.requested(), run_b.requested())]
    ran: dict[Literal["a", "b"], list[AgentProgram]] = {"a": programs(run_a.record), "b": programs(run_b.record)}
    return RunDifference(keys, ran, agents, handler_runs, exact, [*run_a.problems(), *run_b.problems()])


class _ComparedRun:
    """A run directory to compare."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.archive = RunArchive(path)
        self.record = self.archive.record
        if not self.archive.recorded:
            missing = RunDirectoryError(f"{path}: there is no {RUN_FILE}; is this a run directory?")
            raise self.archive.record_error or missing
        self.roster: Sequence[int] = sorted({*self.record.roster})
        self.exports = self.archive.exports
        self.names: Mapping[str, str] = {
            block: known
            for agent_id in self.roster
            for block, known in completed_blocks(self.archive.trace_lines(agent_id), agent_id).items()
        }

    def chain(self, agent_id: int) -> list[str]:
        export = self.exports.by_agent.get(agent_id)
        return [name(block, self.names) for block in export.chain_of_block_hashes] if export else []

    def problems(self) -> Iterator[str]:
        if self.record.outcome == "running":
            yield f"{self.path}: the end of the run is not recorded, so the comparison covers the recorded part"
        yield from self.archive.record_problems
        yield from self.exports.errors

    def requested(self) -> dict[str, object]:
        """Return the scenario of the run as a JSON object that also contains the seed."""
        scenario = self.record.scenario
        return {"seed": self.record.seed, **(scenario.model_dump(mode="json", by_alias=True) if scenario else {})}


def _check_comparable(a: _ComparedRun, b: _ComparedRun) -> None:
    for run in (a, b):
        if not run.roster:
            raise RunDirectoryError(f"{run.path / RUN_FILE}: it names no agents; play the run again")
    if a.roster != b.roster:
        roster_a, roster_b = (", ".join(ranges([*run.roster])) for run in (a, b))
        raise RunDirectoryError(f"A has agents {roster_a}, but B has {roster_b}: compare runs of the same agents")
    if a.record.backend != b.record.backend:
        raise RunDirectoryError(
            "only one run was in virtual time, and traces of virtual time omit messages without effect: compare runs "
            "of the same backend"
        )


def _compare_traces(a: _ComparedRun, b: _ComparedRun, agent_id: int) -> tuple[int, bool, FirstDifference | None]:
    """Compare the traces of an agent. Return the number of equal handler runs, whether the traces are equal to the last
    byte, and the first difference.
    """
    equal, exact = 0, True
    for line_a, line_b in zip_longest(a.archive.trace_lines(agent_id), b.archive.trace_lines(agent_id)):
        if line_a is None or line_b is None or (line_a.incarnation, line_a.text) != (line_b.incarnation, line_b.text):
            exact = False
            step_a, step_b = line_a and ComparedStep.of(line_a, a.names), line_b and ComparedStep.of(line_b, b.names)
            if step_a != step_b:
                return equal, exact, FirstDifference(equal + 1, step_a, step_b)
        equal += 1
    return equal, exact, None


def _compare_chains(a: list[str], b: list[str]) -> ChainDifference | None:
    for place, (block_a, block_b) in enumerate(zip_longest(a, b), 1):
        if block_a != block_b:
            return ChainDifference(place, block_a, block_b)
    return None
