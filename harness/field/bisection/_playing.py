"""Run a scenario or replay a record with the code of another commit, or with another agent program."""

import json
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path

from harness import checker
from harness.archive.archive import RunArchive
from harness.errors import (
    CANNOT_HERE,
    INCOMPLETE,
    INTERRUPTED,
    VIOLATED,
    WRONG_REQUEST,
    HarnessError,
    InterruptedRunError,
)
from harness.field.bisection._live_replay import BusyMachineError, NotStartedError, ReplayFailedError, play_live
from harness.field.bisection.outcome import AgentResult, BisectionSubject, Outcome, RecordDifference, outcome_of_run
from harness.field.replay import open_record
from harness.run.code_state import ROOT, ProcessResult, run_python
from harness.scenario import Scenario

SPEEDUP = 20.0
"""Mission seconds per second of wall time when an agent program replays a record."""
RECORD_CORE = "harness.field.bisection._record_core"
"""The module that replays records with the tested core. The harness starts it as a process."""
CODE = "{code}"
"""A placeholder in an agent command. The harness replaces it by the path of the directory with the code of a commit."""


class UntestableError(HarnessError):
    """An error: this commit cannot be tested, because its code does not start or lacks a required feature."""


class SubjectPlayer:
    """An object that runs one scenario, or replays one record, with the code of several commits. Each commit gets a
    separate directory inside `directory`, and at most `limit_s` seconds.

    Without `command`, the code of the commit runs a scenario in virtual time, and the agent core of the commit replays
    records. With `command`, the installed harness starts agent processes with this command. These processes run the
    scenario, or replay the record of one agent.
    """

    def __init__(
        self,
        subject: BisectionSubject,
        directory: Path,
        *,
        limit_s: float,
        command: str | None = None,
        speedup: float | None = None,
    ) -> None:
        self.subject = subject
        self._directory = directory
        self._limit_s = limit_s
        self._command = command
        self._speedup = speedup
        self._count = 0

    @property
    def is_deterministic(self) -> bool:
        """True if the same code always gives the same run. If it is false, the first difference between two runs is
        meaningless.
        """
        return self.subject.scenario is not None and self._command is None

    def play(self, code: Path) -> tuple[Outcome, Path]:
        """Run the scenario or replay the record with the code in the directory `code`. Return the result and the run
        directory.

        Raises UntestableError.
        """
        self._count += 1
        directory = self._directory / f"play-{self._count}"
        directory.mkdir()
        if self.subject.scenario is None and self._command is not None:
            return self._play_live(code, self._command, directory), directory
        if self.subject.scenario is None:
            return self._play_records(code, directory), directory
        if self._command is None:
            return self._play_in_virtual_time(code, self.subject.scenario, directory)
        return self._play_as_processes(code, self.subject.scenario, self._command, directory)

    # A scenario

    def _play_in_virtual_time(self, code: Path, scenario: Scenario, directory: Path) -> tuple[Outcome, Path]:
        if not (code / "ucp").is_dir():
            raise UntestableError("it has no directory ucp/")
        start_check = run_python(
            ["-c", "import ucp.agent, harness.cli"], first=[code], cwd=directory, limit_s=self._limit_s
        )
        if start_check.status != 0:
            raise UntestableError(f"it does not start: {start_check.last_error_line}")
        run_dir = directory / "run"
        played = run_python(
            [
                *("-m", "harness.cli", "run", str(_scenario_file(scenario, directory)), "--backend", "sim"),
                *("--seed", str(self.subject.seed), "--out", str(run_dir)),
            ],
            first=[code],
            cwd=directory,
            limit_s=self._limit_s,
        )
        if crashed := played.raised_in(code / "ucp"):
            return Outcome(subject=self.subject.in_words, crashed=crashed), run_dir
        return self._judge(played, run_dir, exact=True), run_dir

    def _play_as_processes(self, code: Path, scenario: Scenario, command: str, directory: Path) -> tuple[Outcome, Path]:
        scenario_to_play = _with_command(scenario, _split_command(command, code), self._speedup)
        run_dir = directory / "run"
        played = run_python(
            [
                *("-m", "harness.cli", "run", str(_scenario_file(scenario_to_play, directory)), "--backend", "process"),
                *("--seed", str(self.subject.seed), "--out", str(run_dir)),
            ],
            first=[ROOT],
            cwd=directory,
            limit_s=self._limit_s,
        )
        return self._judge(played, run_dir, exact=False), run_dir

    def _judge(self, played: ProcessResult, run_dir: Path, *, exact: bool) -> Outcome:
        """Return the result of a run. The installed checker judges the run. The checker of the tested commit is not
        used. Raises UntestableError.
        """
        if played.status is None:
            raise UntestableError(f"it did not end within {self._limit_s:g} s; allow more time with --limit-s")
        message = played.last_error_line.replace(f"{run_dir.parent}/", "")
        if played.status == INTERRUPTED:
            raise InterruptedRunError("interrupted")
        archive = RunArchive(run_dir) if (run_dir / "run.json").is_file() else None
        if archive is not None and archive.record.outcome == "not supported":
            raise UntestableError(archive.record.outcome_detail or message)
        if played.status == CANNOT_HERE:
            raise MachineCannotError(message)
        if (
            played.status not in (0, VIOLATED, WRONG_REQUEST, INCOMPLETE)
            or archive is None
            or not archive.exports.by_agent
        ):
            raise UntestableError(message)
        return outcome_of_run(
            self.subject.in_words, checker.check(checker.gather(archive)), archive.exports.by_agent, exact=exact
        )

    # Records

    def _play_records(self, code: Path, directory: Path) -> Outcome:
        if not (code / "ucp").is_dir():
            raise UntestableError("it has no directory ucp/")
        core_directory = directory / "core"
        core_directory.mkdir()
        (core_directory / "ucp").symlink_to(code.resolve() / "ucp", target_is_directory=True)
        agent_argument = [] if self.subject.agent is None else [str(self.subject.agent)]
        played = run_python(
            ["-m", RECORD_CORE, str(self.subject.path), *agent_argument],
            first=[core_directory, ROOT],
            cwd=directory,
            limit_s=self._limit_s,
        )
        if played.status is None:
            raise UntestableError(f"it did not end within {self._limit_s:g} s; allow more time with --limit-s")
        if crashed := played.raised_in(core_directory / "ucp"):
            file = f"/{RECORD_CORE.replace('.', '/')}.py"
            if f'{file}"' in played.stderr and ", in main" in played.stderr:
                return Outcome(subject=self.subject.in_words, crashed=crashed)
            raise UntestableError(f"it does not start: {crashed}")
        try:
            document = json.loads(played.stdout) if played.status == 0 else {}
            agents = {
                int(agent): AgentResult(differences=[RecordDifference.model_validate(each) for each in differences])
                for agent, differences in document["agents"].items()
            }
        except (ValueError, KeyError, TypeError):
            raise UntestableError(played.last_error_line) from None
        return Outcome(subject=self.subject.in_words, agents=agents)

    def _play_live(self, code: Path, command: str, directory: Path) -> Outcome:
        record = open_record(self.subject.path, self.subject.agent)
        arguments = _split_command(command, code)
        try:
            message = play_live(record, arguments, directory, speedup=self._speedup or SPEEDUP)
        except (NotStartedError, BusyMachineError) as error:
            raise UntestableError(str(error)) from None
        except ReplayFailedError as error:
            return Outcome(subject=self.subject.in_words, crashed=str(error))
        return Outcome(subject=self.subject.in_words, agents={record.agent_id: AgentResult(differences=message)})


class MachineCannotError(HarnessError):
    """An error: this machine cannot run the scenario or replay the record with any commit."""

    exit_status = CANNOT_HERE


def _scenario_file(scenario: Scenario, directory: Path) -> Path:
    """Write the scenario to a file without `expect` and without default values, because the tested commit may not
    support them.
    """
    document = scenario.model_dump(mode="json", exclude_defaults=True, exclude={"expect"})
    file = directory / "scenario.yaml"
    file.write_text(json.dumps(document), encoding="utf-8")  # JSON is YAML
    return file


def _with_command(scenario: Scenario, command: Sequence[str], speedup: float | None) -> Scenario:
    speed = {} if speedup is None else {"speedup": speedup}
    return scenario.model_copy(update={"agent_command": list(command), **speed})


def _split_command(command: str, code: Path) -> list[str]:
    """Return the words of the command. Raises HarnessError if it is empty or malformed."""
    try:
        arguments = [word.replace(CODE, str(code)) for word in shlex.split(command)]
    except ValueError as error:
        raise HarnessError(f"--agent-command {command!r} is not a command: {error}") from None
    if not arguments:
        raise HarnessError("--agent-command is empty: name a program, with its arguments")
    if shutil.which(arguments[0]) is None:
        raise UntestableError(f"there is no program {arguments[0]}")
    return arguments
