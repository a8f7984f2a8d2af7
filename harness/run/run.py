"""One run from scenario to verdict: play it, check what it left, write the record and the report."""

import asyncio
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from harness import checker, report
from harness.archive.archive import RunArchive
from harness.archive.directory import RunDirectory
from harness.archive.record import RogueInjection, RunRecord, Survival
from harness.checker.injections import account
from harness.checker.survival import survival
from harness.checker.timer_lag import Lateness, lateness
from harness.errors import VIOLATED, WRONG_REQUEST, HarnessError, MachineError, RunDirectoryError
from harness.play import mission
from harness.play.mission import Played, Story
from harness.play.process.agent import agent_command
from harness.play.process.backend import ProcessRun, open_lab
from harness.play.process.lab import OpenLab
from harness.play.process.preflight import refuse_what_needs_virtual_time, refuse_what_this_machine_cannot
from harness.play.process.vehicle import VehicleFailedError
from harness.play.progress import Progress
from harness.play.simulation.backend import refuse_what_needs_processes
from harness.run.simulate import simulate_into
from harness.scenario import Scenario
from harness.scenario.backend import BackendName
from netem import uml
from sitl.ardupilot import ArduPilot
from sitl.embedded import Embedded
from sitl.vehicle import NoBinaryError, UnusableBinaryError, VehicleType
from sitl.vehicle import VehicleKind as Kind

PACKAGES = ("ucp-harness", "pymavlink", "pyroute2")


@dataclass(frozen=True)
class Run:
    """A finished run: where it is, how it ended, what was found, and the exit status of the command line.

    `lateness` is that of the agents' timers, of processes only, and if enough of them tell.
    """

    directory: Path
    played: Played
    result: checker.Result
    survival: Survival
    rogue: list[RogueInjection]
    exit_status: int
    wall_s: float
    report: Path
    lateness: Lateness | None


def run(scenario: Scenario, seed: int, out: Path, progress: Progress, backend: BackendName = "process") -> Run:
    """Play `scenario` and judge it, into the new or empty directory `out`. Raises HarnessError if it cannot even begin.

    Ctrl-C and SIGTERM end the mission early; what there is is exported and checked all the same.
    """
    play = prepare(scenario, seed, backend)
    recording = Recording(scenario, seed, out, backend)
    try:
        played = asyncio.run(_until_interrupted(play, recording.directory, progress))
    except HarnessError as error:
        recording.fail(error)
        raise
    return recording.end(played)


class Recording:
    """The directory of a run and its record, from its start to the verdict.

    Raises RunDirectoryError if `out` is neither new nor empty, MachineError if the disk refuses the record.
    """

    def __init__(self, scenario: Scenario, seed: int, out: Path, backend: BackendName) -> None:
        self.directory = RunDirectory(out)
        self._started = time.monotonic()
        self._record = RunRecord(
            scenario=scenario,
            roster=list(scenario.roster),
            seed=seed,
            backend=backend,
            versions=versions(),
            started_at=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        )
        self.directory.write_record(self._record)

    def fail(self, error: HarnessError) -> None:
        """The run could not begin."""
        self._update(outcome="failed", outcome_detail=str(error))

    def tell(self, scenario: Scenario) -> None:
        """This is what the run plays: the scenario that it began with, and what it was told since."""
        self._update(scenario=scenario)

    def take_down(self, played: Played) -> None:
        """What has been played by now."""
        self._update(
            engine=played.engine,
            mission_s=played.mission_s,
            settled=played.settled,
            final_reconcile=played.final_reconcile,
            network=played.network,
            faults=played.faults,
            agents=played.agents,
            vehicles=played.vehicles,
            unmatched_fates=played.unmatched_fates,
            counters=played.counters,
            capture=played.capture,
        )

    def end(self, played: Played) -> Run:
        """Judge what was played, and write record and report. Raises MachineError if the disk refuses them."""
        self._record = _updated(self._record, outcome=played.outcome, outcome_detail=played.outcome_detail)
        self.take_down(played)
        archive = RunArchive(self.directory.path)
        evidence = checker.gather(archive)
        result, survived = checker.check(evidence), survival(evidence)
        wall_s = time.monotonic() - self._started
        rogue = account(self._record.scenario, archive)
        self._update(**result.to_json(), survival=survived, rogue=rogue, wall_s=round(wall_s, 1))
        archive.forget_record()
        try:
            page = report.write_report(archive)
        except RunDirectoryError as error:
            raise MachineError(f"{error}; run.json has the verdict") from None
        status = played.exit_status or (VIOLATED if result.violated else WRONG_REQUEST if played.unmatched_fates else 0)
        late = None if self._record.backend == "sim" else lateness(evidence.traces.values())
        return Run(self.directory.path, played, result, survived, rogue, status, wall_s, page, late)

    def _update(self, **keys: Any) -> None:
        self._record = _updated(self._record, **keys)
        self.directory.write_record(self._record)


def _updated(record: RunRecord, **keys: Any) -> RunRecord:
    return RunRecord.model_validate({**record.to_json(), **keys})


Play = Callable[[RunDirectory, Progress, asyncio.Event], Coroutine[Any, Any, Played]]
"""Plays one mission into a run directory, until it is over or the event is set."""


def prepare(scenario: Scenario, seed: int, backend: BackendName, story: Story | None = None) -> Play:
    """What plays `scenario`, or `story` with its swarm. Raises HarnessError if backend or machine cannot."""
    told = story or mission.play
    if backend == "sim":
        refuse_what_needs_processes(scenario)
        return lambda rundir, progress, interrupted: simulate_into(rundir, scenario, seed, progress, interrupted, told)
    refuse_what_needs_virtual_time(scenario)
    refuse_what_this_machine_cannot(scenario)
    kinds = choose_vehicles(scenario)
    opener, command = _made_of_containers(scenario) if backend == "docker" else (open_lab, agent_command(scenario))
    # Another run is another mission: its blocks must not be taken for this one's.
    initial_data = f"{scenario.name}, seed {seed}, {datetime.now(UTC).isoformat()}".encode()
    return lambda rundir, progress, interrupted: ProcessRun(
        scenario,
        seed,
        kinds,
        initial_data,
        rundir,
        progress,
        interrupted,
        agent_command=command,
        open_lab=opener,
        keeps_disks=story is not None,
    ).play(told)


def _made_of_containers(scenario: Scenario) -> tuple[OpenLab, list[str]]:
    """What opens the lab, and what starts an agent there. Raises HarnessError."""
    from harness.play.containers import backend  # the docker SDK takes its time, which others need not wait

    backend.refuse_what_docker_cannot(scenario)
    return backend.open_lab, backend.agent_command(scenario)


async def _until_interrupted(play: Play, directory: RunDirectory, progress: Progress) -> Played:
    interrupted = asyncio.Event()
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        loop.add_signal_handler(number, interrupted.set)
    try:
        return await play(directory, progress, interrupted)
    finally:
        for number, handler in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, handler)


def choose_vehicles(scenario: Scenario) -> dict[VehicleType, Kind]:
    """The kind of each type of vehicle in use; empty: no vehicles.

    ArduPilot if the binaries of all types are found, else the embedded vehicle, unless the scenario says. Raises
    VehicleFailedError for a binary that will not do, MachineError if ArduPilot is asked for and not here.
    """
    vehicles = scenario.vehicles
    if vehicles.kind == "none":
        return {}
    types = dict.fromkeys(vehicles.type_of(vehicle) for vehicle in scenario.roster)
    embedded: dict[VehicleType, Kind] = {vehicle_type: Embedded(vehicle_type) for vehicle_type in types}
    if vehicles.kind == "embedded":
        return embedded
    try:
        return {vehicle_type: ArduPilot.find(vehicles.binary, os.environ, vehicle_type) for vehicle_type in types}
    except NoBinaryError as error:
        if vehicles.kind == "ardupilot":
            raise MachineError(str(error)) from None
        return embedded
    except UnusableBinaryError as error:
        raise VehicleFailedError(str(error)) from None


def versions() -> dict[str, str]:
    """What this ran on, for whoever wants to repeat it."""
    return {
        **{package: version(package) for package in PACKAGES},
        "python": platform.python_version(),
        "kernel": f"{platform.release()} (User Mode Linux)" if uml.inside() else platform.release(),
        "platform": sys.platform,
    }
