"""Run and judge scenarios in virtual time. All data stay in memory, without a run directory.

The checker is the same as for other runs. The checker reads the evidence directly from the agents instead of from
files.
"""

from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from harness import checker
from harness.archive.connectivity import NetworkLine, link_losses
from harness.archive.directory import default_path
from harness.archive.exports import Export, ExportMaker
from harness.archive.run_record import JudgedRecord
from harness.checker import Evidence, Result
from harness.checker.evidence import InjectedDatagram, NetworkLogEntry, RogueTraffic
from harness.checker.judgement import Finding, Judgement
from harness.checker.signatures import TrustedKeys
from harness.errors import AgentFailedError, MachineError, RunDirectoryError
from harness.gc_pause import gc_paused
from harness.play import mission
from harness.play.core_version import edited_files
from harness.play.mission import RunOutcome
from harness.play.simulation.incarnations import SimulatedIncarnation
from harness.play.simulation.run_files import TraceCollection
from harness.play.simulation.simulation import Simulation
from harness.play.simulation.virtual_time import SimulationBackend
from harness.play.variant import variant_in_use
from harness.scenario import Scenario
from harness.scenario.verdict_names import CHARACTERISTICS, ENDED, RUN_CHECKS
from netem.radio import Place
from ucp.trace import Entry

if TYPE_CHECKING:
    from ucp.secure.secured_agent import SecuredAgent

Returned = TypeVar("Returned")


@dataclass(frozen=True)
class Simulated:
    """A run in memory."""

    played: RunOutcome
    """The results of the mission."""
    evidence: Evidence
    result: checker.Result


def simulate(
    scenario: Scenario, seed: int, *, tracing: bool = False, deliver_all: bool = False, again: bool = False
) -> Simulated:
    """Run a scenario in virtual time and check the run in memory, without a run directory. Return the run.

    - `seed`: 0 or more. The same scenario and seed give the same run.
    - `tracing`: record handler runs. Without handler runs, characteristic 1 cannot be judged, and characteristics 2 and
      3 can be judged only at the end of the run.
    - `deliver_all`: also deliver messages that have no effect.
    - `again`: run foreign agents a second time with the same inputs, and compare their answers with the first ones. If
      the run has a bad verdict, the comparison is always made.

    If an agent crashes or hangs, the other agents continue. The result then has the bad verdict `ended`, unless the
    check `steps` already reports this failure. Raises ScenarioError if the scenario needs real processes, and
    HarnessError if an agent does not support the mission or behaves differently when it receives the same inputs again.
    """
    return simulate_in_memory(MemoryRecorder(tracing), scenario, seed, again=again, deliver_all=deliver_all)


@gc_paused()
def simulate_in_memory(
    memory: "MemoryRecorder", scenario: Scenario, seed: int, *, again: bool = False, **options: Any
) -> Simulated:
    """Run and check a scenario as `simulate` does, and store the records of the run in `memory`. `options` are the
    options of the simulation.
    """
    SimulationBackend().refuse(scenario)
    simulation = Simulation(scenario, seed, memory, **options)

    def evidence_at_end() -> Evidence:
        simulation.end()
        return memory.evidence(simulation)

    with closing(simulation):
        run_to_end(mission.play(simulation, scenario))
        evidence = simulation.survive(evidence_at_end)
    result = checker.check(evidence)
    found = [finding.detail for finding in result.beside["steps"].evidence]
    if failures := [error for error in simulation.failures if not any(error.detail in detail for detail in found)]:
        result = replace(result, beside={**result.beside, ENDED: _judge_failures(failures)})
    if (records := simulation.records()) and (again or result.bad):
        from harness.play.simulation.foreign.determinism import DeterminismCheck

        with closing(DeterminismCheck(patient=again)) as second:
            for record in records:
                second.compare(record)
    return Simulated(simulation.played, evidence, result)


def check_determinism(scenario: Scenario, seed: int) -> None:
    """Check that foreign agents (separate programs) give the same answers if they receive the same inputs a second
    time.

    Raises HarnessError if an agent gives different answers or does not support the mission.
    """
    simulate(scenario, seed, tracing=True, again=True)


def run_to_end(story: Coroutine[Any, Any, Returned]) -> Returned:
    """Run a coroutine without an event loop. The coroutine must never wait, which is true for a mission in virtual
    time.
    """
    try:
        story.send(None)
    except StopIteration as end:
        result: Returned = end.value
        return result
    raise AssertionError("the coroutine waits")


class MemoryRecorder:
    """A recorder that stores the traces and records of a simulated run in memory for the checker."""

    def __init__(self, tracing: bool) -> None:
        self.tracing = tracing
        self._traces = TraceCollection()
        self._maker = ExportMaker()
        self._kept: dict[int, Export] = {}
        self._injected = RogueTraffic()
        self._network: list[dict[str, Any]] = []
        """The changes of the network and the faults, as `network.jsonl` contains them."""

    def begin(self, incarnation: SimulatedIncarnation) -> None:
        if self.tracing:
            self._traces.begin(incarnation)

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """Do nothing, because the block contains the event."""

    def write(self, agent_id: int, entries: list[Entry]) -> None:
        self._traces.write(agent_id, entries)

    def changed(self, record: dict[str, Any]) -> None:
        if self.tracing:
            self._network.append(record)

    def injected(self, record: dict[str, Any]) -> None:
        self._injected.add([InjectedDatagram.model_validate(record)])

    def transmitted(self, record: dict[str, Any]) -> None:
        """Do nothing, because the record of the run contains the totals."""

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Do nothing, because the checker does not need positions."""

    def keep_chains(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        self._kept = self._exports(at_s, incarnations)

    def export(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        """Do nothing, because the checker reads the chains from the agents."""

    def evidence(self, simulation: Simulation) -> Evidence:
        """Return the evidence of a run that has ended. Raises AgentFailedError if an agent fails to export its
        chain.
        """
        record = JudgedRecord.model_validate(
            {
                "roster": simulation.roster,
                "outcome": simulation.played.outcome,
                "network": simulation.played.network,
                "final_reconcile": simulation.played.final_reconcile,
                "cycle": simulation.played.cycle,
                "faults": simulation.played.faults,
                "channel": simulation.played.channel,
                "mission_s": simulation.played.mission_s,
                "stagger": simulation.scenario.stagger,
                "lateness": simulation.scenario.lateness,
                "agents": simulation.played.agents,
            }
        )
        return Evidence(
            self._exports(simulation.now(), simulation.exporting()),
            self._traces.by_agent,
            record,
            [],
            self._kept,
            self._injected,
            conditions=[NetworkLogEntry.model_validate(change) for change in self._network] or None,
            link_losses=[*link_losses(map(NetworkLine.model_validate, self._network), simulation.roster)],
            delivers_all=bool(edited_files()) or variant_in_use() is not None,
            keys=TrustedKeys(simulation.public_keys, "the run") if simulation.public_keys else None,
            verified=simulation.verified,
        )

    def _exports(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> dict[int, Export]:
        return {incarnation.agent.agent_id: self._export(at_s, incarnation) for incarnation in incarnations}

    def _export(self, at_s: float, incarnation: SimulatedIncarnation) -> Export:
        if incarnation.state is None:
            return Export.model_validate(incarnation.export(at_s))
        at_us = incarnation.timestamp_us(at_s)
        if incarnation.secured is None:
            return self._maker.export(incarnation.state, at_us)
        secured = cast("SecuredAgent", incarnation.secured)
        return self._maker.export(incarnation.state, at_us, secured.signatures, secured.sign_head(at_us))


EVIDENCE_SHOWN = 5

Judge = Callable[[Scenario, int], Result]
"""A function that runs a scenario with a seed, and returns the verdict on the run."""


@gc_paused()
def simulated(scenario: Scenario, seed: int) -> Result:
    """Simulate a scenario with traces, and return the verdict."""
    return simulate(scenario, seed, tracing=True).result


def _judge_failures(failures: Sequence[AgentFailedError]) -> Judgement:
    """Return the verdict on agents that crashed or hung. The caller omits crashes in handlers, because these already
    count as deviations.
    """
    reason = "; ".join(f"agent {error.agent_id} {error.outcome}" for error in failures)
    findings = [Finding(error.agent_id, f"{error.outcome}: it {error.detail}") for error in failures]
    return Judgement(RUN_CHECKS[ENDED], "violated", reason, findings)


def evidence_lines(violated: dict[str, Judgement]) -> list[str]:
    """Return lines of text about the failed checks and their evidence."""
    lines = []
    for key, judgement in violated.items():
        if key in CHARACTERISTICS:
            lines.append(f"Characteristic {key}, {judgement.name}, is violated, {judgement.reason}")
        else:
            lines.append(f"{judgement.name.capitalize()}: {judgement.verdict}, {judgement.reason}")
        lines += [f"  agent {finding.agent_id}: {finding.detail}" for finding in judgement.evidence[:EVIDENCE_SHOWN]]
        if len(judgement.evidence) > EVIDENCE_SHOWN:
            lines.append(f"  and {len(judgement.evidence) - EVIDENCE_SHOWN} more")
    return lines


def choose_path(out: Path | None, name: str) -> Path:
    """Return the path for a new file: the path `out` if it is given, otherwise a new name under `runs/`. Raises
    RunDirectoryError if `out` exists.
    """
    if out is not None and out.exists():
        raise RunDirectoryError(f"{out} exists: choose another --out; existing files are not overwritten")
    path = out or default_path(f"{name} shrunk").with_suffix(".yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"{path.parent} cannot be created: {error.strerror}; choose another --out") from None
    return path


def write_new_file(path: Path, text: str) -> Path:
    """Write a new file and return its path. If a file with this name exists already, append a number to the name.
    Raises MachineError.
    """
    free, number = path, 2
    while True:
        try:
            with free.open("x", encoding="utf-8") as file:
                file.write(text)
            return free
        except FileExistsError:
            free, number = path.with_stem(f"{path.stem}-{number}"), number + 1
        except OSError as error:
            raise MachineError(f"{free} cannot be written: {error.strerror}") from None
