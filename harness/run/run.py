"""Perform a complete run: run the scenario, check the result, and write record, report and replay file."""

import asyncio
import signal
import threading
import time
from collections.abc import Callable, Collection, Coroutine
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from harness import checker, report
from harness.archive.archive import ReportProgress, RunArchive
from harness.archive.directory import RunDirectory, default_path
from harness.archive.run_record import RogueInjection, RunRecord, Survival
from harness.archive.trace_files import pack_traces
from harness.backend_names import BackendName
from harness.checker.injections import account
from harness.checker.recurring_cycles import cycle_of
from harness.checker.survival import survival
from harness.checker.timer_lag import TimerLag, timer_lag
from harness.errors import (
    WRONG_REQUEST,
    HarnessError,
    InterruptedRunError,
    MachineError,
    RunDirectoryError,
    ScenarioError,
)
from harness.gc_pause import gc_paused
from harness.play import mission
from harness.play.backend import Backend
from harness.play.backends import BACKENDS, in_virtual_time
from harness.play.interventions import Interventions
from harness.play.mission import RunOutcome
from harness.play.progress import ProgressDisplay, SilentProgress
from harness.play.request_socket import serve_requests
from harness.report import facts
from harness.run.provenance import versions
from harness.scenario import Scenario
from harness.scenario.scenario_file import to_yaml
from ucp.agent_files import write_atomically

REPLAY_FILE = "replay.yaml"
CANCELLATION_CHECK_S = 0.5


def replay_of(record: RunRecord, by_hand_s: Collection[float]) -> str:
    """Return the text of a scenario file that repeats the run. `by_hand_s` contains the mission seconds of the timeline
    entries that a user added during the run.
    """
    assert record.scenario is not None
    document = record.scenario.model_dump(mode="json", exclude_defaults=True)
    timeline = [{"at_s": entry["at_s"], **entry} for entry in document["timeline"]]
    document["timeline"] = sorted(timeline, key=lambda entry: entry["at_s"])

    def remark(entry: dict[str, Any]) -> str | None:
        return "by hand" if entry.get("at_s") in by_hand_s else None

    comment = [
        "A run with the changes that the user made by hand. To play it again:",
        f"    {facts.command_again(record, REPLAY_FILE)}",
    ]
    return to_yaml(document, comment, remark)


@dataclass(frozen=True)
class Run:
    """A finished run."""

    directory: Path
    """The run directory."""
    played: RunOutcome
    """The results of the mission."""
    record: RunRecord
    """The content of run.json."""
    result: checker.Result
    """The verdict."""
    survival: Survival
    rogue: list[RogueInjection]
    exit_status: int
    """The exit status for the command line."""
    wall_s: float
    """The wall time in seconds."""
    report: Path
    """The path of report.html."""
    timer_lag: TimerLag | None
    """The lateness of the agents' timers. None in virtual time, and if the traces contain too few timers."""


def run(
    scenario: Scenario,
    seed: int,
    out: Path | None = None,
    progress: ProgressDisplay | None = None,
    backend: BackendName = "process",
    *,
    delivers_all: bool = False,
    interventions: Interventions | None = None,
    scheduler: str | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> Run:
    """Run a scenario, check the run, and write the run directory. Return the finished run.

    - `seed`: 0 or more. The seed determines events, faults and all other random choices of the harness.
    - `out`: the run directory, new or empty. Without it, a new directory under `runs/`.
    - `progress`: the display that shows the state of the swarm during the run. None shows nothing.
    - `backend`: `process` runs the agents in network namespaces, `docker` in containers, and `sim` in virtual time.
    - `delivers_all`: true to record messages without effect in traces, even in virtual time. Traces of processes always
      contain them.
    - `interventions`: faults that the user requests during the run. They must belong to this scenario.
    - `scheduler`: address of a Dask scheduler, whose workers run the agents. It needs the backend `process`.
    - `is_cancelled`: is called repeatedly, for a run in a thread that receives no signals. If it returns true, the
      mission ends as after Ctrl-C.

    Ctrl-C, SIGTERM, SIGHUP and SIGQUIT end the mission early. The agents are then exported, and the run is checked up
    to this moment. Ctrl-C during the check raises InterruptedRunError. The function also works inside a running event
    loop, for example in a notebook. Raises HarnessError if the run cannot start: the scenario does not suit the
    backend, the machine lacks something, or `out` is not empty.
    """
    progress = progress or SilentProgress()
    out = out or default_path(scenario.name)
    chosen = BACKENDS[backend]
    if scheduler is not None:
        from harness.play.hosts.hosts_backend import HostsBackend

        chosen = HostsBackend(scheduler)
    if chosen.name != backend:
        raise ScenarioError(f"--scheduler does not work with --backend {backend}: leave out one of them")
    chosen.refuse(scenario)
    recording = RunRecording(scenario, seed, out, backend, all_delivered=delivers_all and in_virtual_time(backend))
    story: mission.Story = mission.play
    options: dict[str, Any] = {"delivers_all": delivers_all}
    if interventions is not None:
        story = partial(_play_with_requests, interventions, recording.directory)
        options |= {"interactive": interventions.prepares_all_agents, "pace": interventions.pace}
        interventions.on_entry_added = partial(recording.record_requests, interventions)
    interrupted = asyncio.Event()
    running = _until_interrupted(interrupted, chosen, scenario, seed, recording.directory, progress, story, **options)
    if is_cancelled is not None:
        running = _until_cancelled(running, interrupted, is_cancelled)
    try:
        played = _outcome_of(running, interrupted)
    except HarnessError as error:
        recording.fail(error)
        raise
    try:
        return recording.end(played, progress.show_judging)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted before the verdict; all files of the mission are in {recording.directory.path}: "
            f"`ucp-harness check {recording.directory.path}` judges them"
        ) from None


class RunRecording:
    """The directory and the record of a run, from its start to its verdict.

    Raises RunDirectoryError if `out` is neither new nor empty, and MachineError if the record cannot be written.
    """

    def __init__(
        self, scenario: Scenario, seed: int, out: Path, backend: BackendName, *, all_delivered: bool = False
    ) -> None:
        self.directory = RunDirectory(out)
        self._started = time.monotonic()
        self._scenario = scenario
        self._record = RunRecord(
            scenario=scenario,
            roster=list(scenario.roster),
            seed=seed,
            backend=backend,
            versions=versions(),
            all_delivered=all_delivered,
            started_at=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        )
        self.directory.write_record(self._record)

    def fail(self, error: HarnessError) -> None:
        """Record that the run could not be started."""
        self._update(outcome="failed", outcome_detail=str(error))

    def update_scenario(self, scenario: Scenario) -> None:
        """Record the scenario of the run, including the events that the user has requested so far."""
        self._scenario = scenario
        self._update(scenario=scenario)

    def record_requests(self, interventions: Interventions) -> None:
        """Record the actions that the user has requested so far. Also write a scenario file that repeats the run with
        these actions.
        """
        self.update_scenario(interventions.scenario)
        by_hand_s = [entry.at_s for entry in interventions.by_hand]
        replay = replay_of(self._record, by_hand_s)
        try:
            write_atomically(self.directory.path / REPLAY_FILE, replay)
        except OSError as error:
            raise MachineError(f"{self.directory.path / REPLAY_FILE} cannot be written: {error.strerror}") from None

    def record_outcome(self, played: RunOutcome) -> None:
        """Record the results of the mission so far."""
        self._update(
            engine=played.engine,
            mission_s=played.mission_s,
            settled=played.settled,
            final_reconcile=played.final_reconcile,
            cycle=played.cycle,
            network=played.network,
            faults=played.faults,
            agents=played.agents,
            vehicles=played.vehicles,
            unmatched_fates=played.unmatched_fates,
            counters=played.counters,
            datagrams=played.datagrams,
            channel=played.channel,
            capture=played.capture,
            ground_station=played.ground_station,
            remote=played.remote,
            keys_fingerprint=self.directory.keys_fingerprint,
        )

    @gc_paused()
    def end(self, played: RunOutcome, report_progress: ReportProgress = lambda step: None) -> Run:
        """Check the run, and write its record and report. `report_progress` is called with the name of each long step.

        Raises MachineError if they cannot be written.
        """
        self._record = _updated(self._record, outcome=played.outcome, outcome_detail=played.outcome_detail)
        self.record_outcome(played)
        archive = RunArchive(self.directory.path, traces=played.traces, report_progress=report_progress)
        evidence = checker.gather(archive)
        result, survived = checker.check(evidence), survival(evidence)
        wall_s = time.monotonic() - self._started
        rogue = account(self._scenario, archive)
        found = evidence.cached(cycle_of)
        cycle = found.model_dump() if found else None
        self._update(
            **result.to_json(),
            cycle=cycle,
            survival=survived,
            rogue=rogue,
            wall_s=round(wall_s, 1),
        )
        archive.forget_record()
        report_progress("writing the report")
        try:
            page = report.write_report(archive)
        except RunDirectoryError as error:
            raise MachineError(f"{error}; run.json has the verdict") from None
        pack_traces(self.directory.agents, report_progress)
        status = played.exit_status or result.exit_status or (WRONG_REQUEST if played.unmatched_fates else 0)
        late = None if in_virtual_time(self._record.backend) else timer_lag(evidence.traces.values(), evidence.lag)
        return Run(self.directory.path, played, self._record, result, survived, rogue, status, wall_s, page, late)

    def _update(self, **keys: Any) -> None:
        self._record = _updated(self._record, **keys)
        self.directory.write_record(self._record)


def _updated(record: RunRecord, **keys: Any) -> RunRecord:
    return RunRecord.model_validate({**record.to_json(), **keys})


async def _play_with_requests(
    interventions: Interventions, directory: RunDirectory, swarm: mission.Swarm, scenario: Scenario
) -> None:
    """Run a mission during which a user or another process can request events."""
    async with serve_requests(interventions, directory.path):
        await interventions.story(swarm, scenario)


def _outcome_of(run: Coroutine[Any, Any, RunOutcome], interrupted: asyncio.Event) -> RunOutcome:
    """Run a coroutine to its end. If this thread already runs an event loop, as in a notebook, start another thread for
    it.
    """
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(run)
    runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
    loop = runner.get_loop()

    def in_thread() -> RunOutcome:
        with runner:
            return runner.run(run)

    with ThreadPoolExecutor(1, "ucp-run") as thread:
        playing = thread.submit(in_thread)
        try:
            return playing.result()
        except KeyboardInterrupt:
            loop.call_soon_threadsafe(interrupted.set)
            return playing.result()


async def _until_cancelled(
    running: Coroutine[Any, Any, RunOutcome], interrupted: asyncio.Event, is_cancelled: Callable[[], bool]
) -> RunOutcome:
    """Carry out a run. Set `interrupted` as soon as `is_cancelled` returns true."""

    async def watch() -> None:
        while not is_cancelled():
            await asyncio.sleep(CANCELLATION_CHECK_S)
        interrupted.set()

    watching = asyncio.create_task(watch())
    try:
        return await running
    finally:
        watching.cancel()


_ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


async def _until_interrupted(
    interrupted: asyncio.Event,
    backend: Backend,
    scenario: Scenario,
    seed: int,
    directory: RunDirectory,
    progress: ProgressDisplay,
    story: mission.Story,
    **options: Any,
) -> RunOutcome:
    loop = asyncio.get_running_loop()
    handled = _ENDING_SIGNALS if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.getsignal(number) for number in handled}
    before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}  # as under nohup
    for number in before:
        loop.add_signal_handler(number, interrupted.set)
    try:
        opening = backend.open(scenario, seed, directory, progress, interrupted, **options)
        return await mission.play_on(opening, scenario, story)
    finally:
        for number, handler in before.items():
            loop.remove_signal_handler(number)
            signal.signal(number, handler)
