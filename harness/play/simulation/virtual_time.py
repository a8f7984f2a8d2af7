"""The simulation backend, which simulates a swarm in virtual time, and writes a run directory like the other
backends.
"""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, closing, contextmanager
from typing import TYPE_CHECKING

from harness.archive.directory import RunDirectory
from harness.archive.run_record import CapturedFrames
from harness.errors import AgentFailedError, InterruptedRunError, MachineError, ScenarioError
from harness.play._ground_station_check import refuse_unreachable_ground_station
from harness.play._pace import VirtualTimePace
from harness.play._vehicle_keys import require_key_packages
from harness.play.backend import Backend
from harness.play.progress import ProgressDisplay, SwarmSnapshot
from harness.play.simulation.air import VirtualAir
from harness.play.simulation.foreign._answer import AgentLacksError
from harness.play.simulation.run_files import DiskRecorder
from harness.play.simulation.simulation import Simulation, no_vehicles
from harness.play.trace_space import trace_quota
from harness.scenario import Scenario
from harness.scenario.faults import VehicleFault

if TYPE_CHECKING:
    from harness.play.simulation._captured_air import VirtualCapture
    from harness.play.simulation._station_tracks import StationTracks
    from harness.play.simulation.foreign._program_pool import ProgramPool


class SimulationBackend(Backend):
    """The backend that simulates a swarm in virtual time, in this process."""

    name = "sim"
    virtual_time = True
    plays_in_memory = True
    not_in_uml = "--kernel uml is for real processes: virtual time, --backend sim, needs no kernel"

    def refuse(self, scenario: Scenario) -> None:
        asked = {
            "vehicles.kind: ardupilot": scenario.vehicles.kind == "ardupilot",
            "vehicles.binary": scenario.vehicles.binary is not None,
            **{f"vehicles.{key}": True for key in _of_real_vehicles(scenario)},
            "remote": scenario.remote is not None,
        }
        keys = [f"`{key}`" for key, needed in asked.items() if needed]
        if keys:
            verb = "need" if len(keys) > 1 else "needs"
            raise ScenarioError(f"{', '.join(keys)} {verb} real processes: use --backend process, or leave it out")
        befall = {fault.what: fault for fault in scenario.faults_in_order() if isinstance(fault, VehicleFault)}
        if befall:
            raise ScenarioError(no_vehicles([*befall]))
        refuse_unreachable_ground_station(scenario)
        require_key_packages(scenario)
        if scenario.foreign:
            _refuse_what_foreign_agents_cannot(scenario)

    def remark(self, scenario: Scenario) -> str | None:
        if scenario.events.source != "mavlink":
            return None
        return "Virtual time has no telemetry: events are random (Algorithm 21)."

    @asynccontextmanager
    async def open(
        self,
        scenario: Scenario,
        seed: int,
        rundir: RunDirectory,
        progress: ProgressDisplay,
        interrupted: asyncio.Event,
        *,
        interactive: bool = False,
        delivers_all: bool = False,
        pace: VirtualTimePace | None = None,
    ) -> AsyncIterator[Simulation]:
        station: StationTracks | None = None

        async def on_progress(simulation: Simulation) -> None:
            progress.show(simulation.survive(lambda: _snapshot(simulation)))
            if station is not None:
                station.show(simulation.now(), simulation.lost_vehicles)
            await asyncio.sleep(0)  # the loop handles Ctrl-C now
            if interrupted.is_set():
                raise InterruptedRunError(f"the run was interrupted at mission second {simulation.now():.0f}")

        quota = trace_quota(scenario, rundir.path)
        with closing(DiskRecorder(rundir, quota)) as files, _programs(scenario, rundir) as programs:
            capture = _captures(rundir, scenario) if scenario.capture else None
            air = capture.air if capture else VirtualAir
            if scenario.gcs and pace is None:
                pace = VirtualTimePace(scenario.speedup)  # an operator could not follow unlimited time
            simulation = Simulation(
                scenario,
                seed,
                files,
                deliver_all=delivers_all,
                interactive=interactive,
                on_progress=on_progress,
                pace=pace,
                air=air,
                programs=programs,
            )
            if scenario.gcs:
                station = await _open_station(simulation)
            try:
                if simulation.public_keys is not None:
                    rundir.write_public_keys(simulation.public_keys)
                yield simulation
            except InterruptedRunError as error:
                simulation.played.end_early("interrupted", error)
            except (AgentFailedError, AgentLacksError) as error:
                simulation.fail(error)
            except OSError as error:
                simulation.played.end_early("failed", _failure(error, rundir))
            if station is not None:
                simulation.played.ground_station = station.close()
            try:
                _export(simulation, files)
                if capture:
                    simulation.played.capture = {
                        vehicle: CapturedFrames.model_validate(frames)
                        for vehicle, frames in capture.end(simulation.now()).items()
                    }
            except OSError as error:
                simulation.played.end_early("failed", _failure(error, rundir))
            if simulation.records() and simulation.played.outcome == "completed":
                await _compare_again(simulation, on_progress)
            for agent_id, problem in files.problems().items():
                simulation.played.agents[str(agent_id)].trace_problem = problem
            simulation.played.traces = files.traces
            for agent_id, names in programs.close().items() if programs else ():
                simulation.played.agents[str(agent_id)].left_behind = names


def _of_real_vehicles(scenario: Scenario) -> list[str]:
    """Return the keys of the scenario that work only with real vehicle programs."""
    asked = (scenario.vehicles, *scenario.vehicles.each.values())
    keys = ("frame", "parameters", "wind", "arguments", "debugger")
    return [key for key in keys if any(getattr(vehicles, key) for vehicles in asked)]


async def _open_station(simulation: Simulation) -> "StationTracks":
    from harness.play.simulation._station_tracks import StationTracks  # imports MAVLink, which is slow

    return await StationTracks.open(simulation.scenario, simulation.tracks, simulation.now)


def _export(simulation: Simulation, files: DiskRecorder) -> None:
    """Record the end of the run, and export the chains of all agents that have not failed. Raises OSError."""
    while True:
        try:
            simulation.end()
            files.export(simulation.now(), simulation.exporting())
            return
        except (AgentFailedError, AgentLacksError) as error:
            simulation.fail(error)


async def _compare_again(simulation: Simulation, on_progress: Callable[[Simulation], Awaitable[None]]) -> None:
    """Check that foreign agents are deterministic. Send the inputs of each agent to a program a second time, and
    compare the answers with the first answers.
    """
    from harness.play.simulation.foreign.determinism import DeterminismCheck, NondeterminismError

    simulation.enter("the same again")
    with closing(DeterminismCheck(patient=True)) as again:
        try:
            for record in simulation.records():
                await on_progress(simulation)
                again.compare(record)
        except NondeterminismError as error:
            simulation.played.end_early("failed", error)
        except InterruptedRunError as error:
            simulation.played.end_early("interrupted", error)


@contextmanager
def _programs(scenario: Scenario, rundir: RunDirectory) -> Iterator["ProgramPool | None"]:
    """Yield a pool of programs for the foreign agents, with log files in the run directory. Yield None if the scenario
    has no foreign agents.
    """
    if not scenario.foreign:
        yield None
        return
    from harness.play.simulation.foreign._program_pool import ProgramPool

    with closing(ProgramPool(rundir.agents)) as programs:
        yield programs


def _refuse_what_foreign_agents_cannot(scenario: Scenario) -> None:
    from harness.play.simulation.foreign._foreign_swarm import commands_of

    commands_of(scenario)
    late = sorted(agent_id for agent_id in scenario.lateness if agent_id in scenario.foreign)
    if late:
        raise ScenarioError(
            f"`lateness` names agent {late[0]}, but the harness controls the timers of its own agents only: leave out "
            "`lateness`, or the `agent_command` of this agent"
        )


def _failure(error: OSError, rundir: RunDirectory) -> MachineError:
    return MachineError(f"{error.strerror}: {error.filename or rundir.path}")


def _captures(rundir: RunDirectory, scenario: Scenario) -> "VirtualCapture":
    from harness.play.simulation._captured_air import VirtualCapture  # imports the network modules, which is slow

    try:
        return VirtualCapture(rundir.capture(), scenario.roster)
    except OSError as error:
        raise MachineError(f"{error.strerror}: {error.filename}") from None


def _snapshot(simulation: Simulation) -> SwarmSnapshot:
    statuses = {incarnation.agent.agent_id: incarnation.agent.status() for incarnation in simulation.living()}
    return SwarmSnapshot(
        simulation.stage, simulation.now(), simulation.scenario.duration_s, simulation.network, statuses
    )
