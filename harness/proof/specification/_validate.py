"""Check with TLC whether the TLA+ specification allows the recorded steps of agents.

One TLC process checks the records of many agents, because its start takes longer than the check of one agent.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.traces import Trace, read_trace, why_not_a_trace
from harness.checker.steps.core_in_use import settings_in_use
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, checked
from harness.errors import INTERRUPTED, VIOLATED, WRONG_REQUEST
from harness.proof.specification._recorded_incarnations import ChainNumbers, EncodedIncarnation, lives, module
from harness.proof.specification._spec_states import readings, unspecified
from harness.proof.specification._tlc import CheckerError, command, in_tla
from harness.proof.specification._tlc import checked as looked_at
from harness.run.simulate import simulate
from harness.scenario import Scenario
from ucp.agent import HANDLERS

STEPS_AT_ONCE = 20_000
"""Minimum number of handler runs in a batch for one TLC process. A batch may contain more handler runs, because a trace
is never divided.
"""
MEMORY_MB = 2048

Constants = tuple[tuple[str, object], ...]

AT_END = "what it triggered has yet to run"
"""The name of the difference that TLC reports at the last step if a handler was triggered but did not run."""

_REJECTED = re.compile(r'<<\s*"rejected",\s*(\d+),\s*(\d+),\s*\{([^}]*)\}\s*>>')
_WHAT = re.compile(r'"([^"]*)"')


@dataclass(frozen=True)
class RejectedStep:
    """The first step of an agent that the specification does not allow. `what` lists the differing parts of the
    step.
    """

    run: str
    agent_id: int
    life: int
    line: int
    handler: str
    what: tuple[str, ...]

    def in_words(self) -> str:
        algorithm = HANDLERS[self.handler].algorithm
        life = f", life {self.life}" if self.life > 1 else ""
        return (
            f"{self.run}: agent {self.agent_id}{life}, line {self.line}, Algorithm {algorithm}, {self.handler}: "
            f"not as specified: {', '.join(self.what)}"
        )


@dataclass
class TraceValidation:
    """The result of a validation: the numbers of runs and steps, the rejected steps, and the reasons why records could
    not be checked.

    `interrupted` is true if the user stopped the validation. The later records were then not checked.
    """

    runs: int = 0
    lives: int = 0
    steps: int = 0
    rejected: list[RejectedStep] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def exit_status(self) -> int:
        if self.interrupted and not self.rejected:
            return INTERRUPTED
        return VIOLATED if self.rejected else WRONG_REQUEST if self.unread or not self.steps else 0

    def to_json(self) -> dict[str, object]:
        return {"schema": "ucp-validation/1", **asdict(self)}

    def in_words(self) -> Iterator[str]:
        for rejected in self.rejected:
            yield f"✘ {rejected.in_words()}"
        for sentence in self.unread:
            yield f"- {sentence}"
        runs = f"{self.runs:,} run{'s' if self.runs != 1 else ''}"
        looked = f"{runs}, {self.lives:,} lives of agents, {self.steps:,} handler runs"
        if self.rejected:
            count = len(self.rejected)
            yield f"✘ {looked}: {count:,} {'life' if count == 1 else 'lives'} not as specified"
        elif not self.steps:
            yield f"- {looked}: nothing could be checked"
        elif self.exit_status == 0:
            yield f"✔ {looked}: all as specified"
        else:
            yield f"- {looked}: as specified, as far as they could be checked"


@dataclass
class _EncodedStepBatch:
    """Encoded steps of several agents that one TLC process checks, with the name of the run to which each agent
    belongs.
    """

    chains: ChainNumbers = field(default_factory=ChainNumbers)
    lives: list[EncodedIncarnation] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    steps: int = 0


@dataclass(frozen=True)
class RunTraces:
    """A recorded run: its name, its traces, the agents that reached the end of the mission, and problems with its
    files.
    """

    name: str
    traces: Sequence[Trace]
    ended: Collection[int] = ()
    problems: Sequence[str] = ()


def recorded(paths: Iterable[Path]) -> Iterator[RunTraces]:
    """Yield the recorded run at each path: a run directory, a directory with agents' files, or a trace. Raises
    RunDirectoryError for any other path.
    """
    for path in paths:
        if path.is_file():
            trace = read_trace(path)
            yield RunTraces(str(path), [trace] if trace else [], problems=[] if trace else [why_not_a_trace(path)])
            continue
        archive = RunArchive(path)
        traces = archive.traces
        missing = sorted(set(archive.roster) - set(traces)) if traces else []
        problems = [*archive.problems, *(f"the trace of agent {agent_id} is missing" for agent_id in missing)]
        problems += [] if traces else ["no traces found"]
        yield RunTraces(str(path), list(traces.values()), archive.exports.by_agent.keys(), problems)


def simulated(scenario: Scenario, seeds: Iterable[int]) -> Iterator[RunTraces]:
    """Yield a simulated run of the scenario for each seed. Raises HarnessError."""
    for seed in seeds:
        evidence = simulate(scenario, seed, tracing=True).evidence
        yield RunTraces(f"seed {seed}", list(evidence.traces.values()), evidence.exports.keys())


def validate(
    runs: Iterable[RunTraces], *, watch: Callable[[TraceValidation], None] = lambda validation: None
) -> TraceValidation:
    """Check all runs against the specification. Raises NoCheckerError without TLC."""
    command()
    validation = TraceValidation()
    try:
        for constants, batch in _batches(runs, validation):
            _look(constants, batch, validation)
            watch(validation)
    except KeyboardInterrupt:
        validation.interrupted = True
    return validation


def _batches(runs: Iterable[RunTraces], validation: TraceValidation) -> Iterator[tuple[Constants, _EncodedStepBatch]]:
    batches: dict[Constants, _EncodedStepBatch] = {}
    for run in runs:
        validation.runs += 1
        validation.unread += [f"{run.name}: {problem}" for problem in run.problems]
        for trace in run.traces:
            try:
                header, constants = _constants(trace)
            except _OutsideError as error:
                validation.unread.append(f"{run.name}: agent {trace.header.agent_id}: {error}")
                continue
            batch = batches.setdefault(constants, _EncodedStepBatch())
            for life in lives(trace, header, batch.chains, ended=header.agent_id in run.ended):
                batch.lives.append(life)
                batch.names.append(run.name)
                batch.steps += len(life.steps)
                if life.unread is not None:
                    validation.unread.append(f"{run.name}: agent {life.agent_id}: {life.unread}")
            if batch.steps >= STEPS_AT_ONCE:
                yield constants, batches.pop(constants)
    yield from batches.items()


class _OutsideError(Exception):
    """An error: a trace cannot be checked, because the specification does not support it. The message is the reason."""


def _constants(trace: Trace) -> tuple[CheckedHeader, Constants]:
    """Return the mission of the agent, and the constants for TLC. Raises _OutsideError if the specification does not
    support the mission.
    """
    if not trace.header.has_inputs:
        raise _OutsideError("its trace has the version ucp-trace/1, which lacks received messages")
    try:
        header = checked(trace.header)
    except ImpossibleHeaderError as error:
        raise _OutsideError(str(error)) from None
    settings = settings_in_use(header)
    if (name := unspecified(settings)) is not None:
        raise _OutsideError(f"the specification does not have its setting {name}")
    return header, (
        ("SizeMaxEvent", settings.max_event_bytes),
        ("SizeMaxBlock", settings.max_block_bytes),
        ("FinalizeGap", settings.finalize_gap_s > 0),
        *readings(settings).items(),
    )


def _look(constants: Constants, batch: _EncodedStepBatch, validation: TraceValidation) -> None:
    """Check a batch with TLC. If TLC fails, divide the batch into halves and check each half in the same way. In the
    end, only agents with which TLC fails remain unchecked.
    """
    try:
        rejected = _rejected(constants, batch)
    except CheckerError as error:
        if len(batch.lives) == 1:
            validation.unread.append(f"{batch.names[0]}: agent {batch.lives[0].agent_id}: {error}")
            return
        middle = len(batch.lives) // 2
        for half in (slice(middle), slice(middle, None)):
            _look(constants, _EncodedStepBatch(batch.chains, batch.lives[half], batch.names[half]), validation)
        return
    for number, (life, name) in enumerate(zip(batch.lives, batch.names, strict=True), 1):
        validation.lives += 1
        if number not in rejected:
            validation.steps += len(life.steps)
            continue
        step, what = rejected[number]
        validation.steps += step
        line, handler = life.lines[step - 1], life.handlers[step - 1]
        validation.rejected.append(RejectedStep(name, life.agent_id, life.number, line, handler, what))


def _config(constants: Constants) -> str:
    """Return the TLC configuration for agents with these constants."""
    assigned = (f"  {name} = {in_tla(value)}" for name, value in constants)
    return "\n".join(["SPECIFICATION Spec", "VIEW Position", "CONSTANTS", *assigned, ""])


def _rejected(constants: Constants, batch: _EncodedStepBatch) -> dict[int, tuple[int, tuple[str, ...]]]:
    """Return the first rejected step of each rejected agent, with the parts of the step that differ. The key is the
    number of the agent in the batch, counted from 1. Raises CheckerError.
    """
    records = {"Lives": module(batch.lives, batch.chains)}
    with looked_at("Recorded", _config(constants), others=records, memory_mb=MEMORY_MB) as said:
        rejected = {
            int(number): (int(step), tuple(sorted(_WHAT.findall(what))))
            for number, step, what in _REJECTED.findall(said.output)
        }
    positions = 1
    for number, life in enumerate(batch.lives, 1):
        step, what = rejected.get(number, (len(life.steps), (AT_END,)))
        positions += step + (AT_END in what)
    if positions != said.distinct:
        raise CheckerError(f"TLC checked {said.distinct} positions of {positions}")
    return rejected
