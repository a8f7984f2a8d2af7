"""Scenarios in virtual time: into a run directory as any other run, or in memory, for sweeps over thousands of runs.

Both are judged by the same checker. In memory the evidence comes straight from the agents, without files between.
"""

import asyncio
import dataclasses
from collections.abc import Coroutine, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

from harness import checker
from harness.archive.directory import RunDirectory
from harness.archive.exports import Export, ExportMaker
from harness.archive.record import JudgedRecord
from harness.archive.traces import Header, Trace
from harness.checker import Evidence
from harness.errors import InterruptedRunError, MachineError
from harness.play import mission
from harness.play.control import Status
from harness.play.mission import Played, Story
from harness.play.progress import Progress, Snapshot
from harness.play.simulation.air import VirtualAir
from harness.play.simulation.backend import Life, Simulation, refuse_what_needs_processes
from harness.play.simulation.captured_air import CapturedAir, VirtualCapture
from harness.scenario import Scenario
from netem.radio import Place
from ucp.export import export_chain
from ucp.files import TraceFile, write_json_atomically
from ucp.trace import HandlerRun, header_line


@dataclass(frozen=True)
class Simulated:
    """A simulated run, judged."""

    played: Played
    evidence: Evidence
    result: checker.Result


def simulate(scenario: Scenario, seed: int, *, tracing: bool = False, deliver_all: bool = False) -> Simulated:
    """Play `scenario` in virtual time and judge it, all in memory.

    Without `tracing` characteristic 1 cannot be judged, and 2 and 3 only at the end. `deliver_all` delivers even what
    changes nothing. Raises ScenarioError for a scenario that needs real processes.
    """
    return simulate_in_memory(InMemory(tracing), scenario, seed, deliver_all=deliver_all)


def simulate_in_memory(memory: "InMemory", scenario: Scenario, seed: int, **options: Any) -> Simulated:
    """As `simulate`; `memory` keeps the run, and `options` are the simulation's."""
    refuse_what_needs_processes(scenario)
    simulation = Simulation(scenario, seed, memory, **options)
    _without_waiting(mission.play(simulation, scenario))
    simulation.end()
    evidence = memory.evidence(simulation)
    return Simulated(simulation.played, evidence, checker.check(evidence))


async def simulate_into(
    rundir: RunDirectory, scenario: Scenario, seed: int, progress: Progress, interrupted: asyncio.Event, story: Story
) -> Played:
    """Play `story` in virtual time into a run directory, as agents as processes would."""

    async def breathe(simulation: Simulation) -> None:
        progress.show(_snapshot(simulation))
        await asyncio.sleep(0)  # lets the loop hear of Ctrl-C
        if interrupted.is_set():
            raise InterruptedRunError(f"the run was interrupted at mission second {simulation.now():.0f}")

    with closing(OnDisk(rundir)) as files:
        capture = _captures(rundir, scenario) if scenario.capture else None
        air = partial(CapturedAir, capture) if capture else VirtualAir
        simulation = Simulation(scenario, seed, files, breathe=breathe, air=air)
        try:
            await story(simulation, scenario)
        except InterruptedRunError as error:
            simulation.played.end_early("interrupted", error)
        except OSError as error:
            simulation.played.end_early("failed", MachineError(f"{error.strerror}: {error.filename or rundir.path}"))
        simulation.end()
        try:
            if capture:
                simulation.played.capture = capture.end(simulation.now())
            files.export(simulation)
        except OSError as error:
            simulation.played.end_early("failed", MachineError(f"{error.strerror}: {error.filename or rundir.path}"))
        for agent_id, problem in files.problems().items():
            simulation.played.agents[str(agent_id)]["trace_problem"] = problem
    return simulation.played


def _captures(rundir: RunDirectory, scenario: Scenario) -> VirtualCapture:
    try:
        return VirtualCapture(rundir.capture(), scenario.roster)
    except OSError as error:
        raise MachineError(f"{error.strerror}: {error.filename}") from None


def _snapshot(simulation: Simulation) -> Snapshot:
    statuses = {life.agent.agent_id: _status(life) for life in simulation.living()}
    return Snapshot(simulation.stage, simulation.now(), simulation.scenario.duration_s, simulation.network, statuses)


def _status(life: Life) -> Status:
    state = life.agent.state
    return Status.model_construct(
        idle=state.idle,
        reconcile_in_progress=state.reconcile_in_progress,
        chain=len(state.chain),
        deque=len(state.blocks_to_be_committed),
        completed=len(state.completed),
        reconciles=state.reconciles,
    )


def _without_waiting(story: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine that waits for nothing, as virtual time does not, without an event loop."""
    try:
        story.send(None)
    except StopIteration:
        return
    raise AssertionError("virtual time waits for nothing")


class InMemory:
    """Keeps everything as the checker wants it."""

    def __init__(self, tracing: bool) -> None:
        self.tracing = tracing
        self._traces: dict[int, Trace] = {}
        self._maker = ExportMaker()
        self._kept: dict[int, Export] = {}

    def begin(self, life: Life) -> None:
        if not self.tracing:
            return
        trace = self._traces.get(life.agent.agent_id)
        if trace is None:
            self._traces[life.agent.agent_id] = Trace(Header.model_validate(_header(life)))
        else:
            trace.starts.append(len(trace.runs))

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """The block that it becomes part of has it."""

    def write(self, agent_id: int, runs: list[HandlerRun]) -> None:
        self._traces[agent_id].runs += runs

    def changed(self, record: dict[str, Any]) -> None:
        """The run's record has it."""

    def injected(self, record: dict[str, Any]) -> None:
        """The account of the rogue node is made of a run directory."""

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Nobody asks where vehicles were."""

    def keep_chains(self, simulation: Simulation) -> None:
        self._kept = self._exports(simulation)

    def export(self, simulation: Simulation) -> None:
        """The evidence is made of the agents themselves."""

    def evidence(self, simulation: Simulation) -> Evidence:
        record = JudgedRecord.model_validate(
            {
                "roster": simulation.roster,
                "network": simulation.played.network,
                "final_reconcile": simulation.played.final_reconcile,
                "faults": simulation.played.faults,
                "mission_s": simulation.played.mission_s,
                "agents": simulation.played.agents,
            }
        )
        return Evidence(self._exports(simulation), self._traces, record, before_final_reconcile=self._kept)

    def _exports(self, simulation: Simulation) -> dict[int, Export]:
        return {
            life.agent.agent_id: self._maker.export(life.agent.state, simulation.timestamp_us(life))
            for life in simulation.living()
        }


class OnDisk:
    """Writes the files of a run directory that agents as processes would write themselves."""

    tracing = True

    def __init__(self, rundir: RunDirectory) -> None:
        self._rundir = rundir
        self._traces: dict[int, TraceFile] = {}

    def begin(self, life: Life) -> None:
        agent_id = life.agent.agent_id
        if agent_id not in self._traces:
            self._traces[agent_id] = TraceFile(self._rundir.agents / f"{agent_id}.trace.jsonl")
        self._traces[agent_id].write(header_line(**_header(life)))

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """The block that it becomes part of has it."""

    def write(self, agent_id: int, runs: list[HandlerRun]) -> None:
        self._traces[agent_id].write("".join([run.to_line() for run in runs]))

    def changed(self, record: dict[str, Any]) -> None:
        self._rundir.append_network(record)

    def injected(self, record: dict[str, Any]) -> None:
        self._rundir.append_injected(record)

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        self._rundir.append_tracks(at_s, places)

    def keep_chains(self, simulation: Simulation) -> None:
        self.export(simulation)
        self._rundir.keep_exports_before_final_reconcile()

    def export(self, simulation: Simulation) -> None:
        """Raises OSError."""
        for life in simulation.living():
            path = self._rundir.agents / f"{life.agent.agent_id}.chain.json"
            write_json_atomically(path, export_chain(life.agent.state, simulation.timestamp_us(life)))

    def problems(self) -> dict[int, str]:
        """Why the trace of which agent ends early."""
        return {agent_id: trace.problem for agent_id, trace in self._traces.items() if trace.problem}

    def close(self) -> None:
        for trace in self._traces.values():
            trace.close()


def _header(life: Life) -> dict[str, Any]:
    """The first line of a trace, as keywords of `ucp.trace.header_line`."""
    agent = life.agent
    clock = {"epoch_us": 0, "speedup": 1, **(life.clock.model_dump() if life.clock else {})}
    return {
        "agent_id": agent.agent_id,
        "roster": sorted(agent.roster),
        "settings": dataclasses.asdict(agent.state.settings),
        "clock": clock,
    }
