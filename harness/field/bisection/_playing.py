"""Playing a subject with a state of the code in the place of the installed one, or with another agent command."""

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
from harness.field.bisection._live_replay import NotStartedError, ReplayFailedError, play_live
from harness.field.bisection.outcome import Difference, OfAgent, Outcome, Subject, of_run
from harness.field.replay import open_record
from harness.run.code_state import ROOT, Ended, run_python
from harness.scenario import Scenario

SPEEDUP = 20.0
"""Mission seconds per second, of a record that is given to a process."""
RECORD_CORE = "harness.field.bisection._record_core"
"""The module that runs as a process and gives records to the core under test."""
CODE = "{code}"
"""In an agent command: the directory of the state of the code."""


class CannotBeTriedError(HarnessError):
    """Nothing can be said of this state of the code: it does not start, or does not know what it is asked to play."""


class Workshop:
    """Plays the subject, each time in a new directory below `directory`; nothing may take longer than `limit_s`.

    Without `command` a scenario is played in virtual time, whole, by the state of the code that is tried, and records
    are given to its core. With it a scenario is played as processes by the harness that runs now, and one agent's
    record is given to the agent as a process.
    """

    def __init__(
        self,
        subject: Subject,
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
    def plays_the_same(self) -> bool:
        """Whether the same code gives the same run, so that it means something where two runs part."""
        return self.subject.scenario is not None and self._command is None

    def play(self, code: Path) -> tuple[Outcome, Path]:
        """What comes of it with this state of the code, and the run directory. Raises CannotBeTriedError."""
        self._count += 1
        place = self._directory / f"play-{self._count}"
        place.mkdir()
        if self.subject.scenario is None and self._command is not None:
            return self._given_by_udp(code, self._command, place), place
        if self.subject.scenario is None:
            return self._given_records(code, place), place
        if self._command is None:
            return self._in_virtual_time(code, self.subject.scenario, place)
        return self._as_processes(code, self.subject.scenario, self._command, place)

    # A scenario

    def _in_virtual_time(self, code: Path, scenario: Scenario, place: Path) -> tuple[Outcome, Path]:
        if not (code / "ucp").is_dir():
            raise CannotBeTriedError("it has no directory ucp/")
        starts = run_python(["-c", "import ucp.agent, harness.cli"], first=[code], cwd=place, limit_s=self._limit_s)
        if starts.status != 0:
            raise CannotBeTriedError(f"it does not start: {starts.last_words}")
        run_dir = place / "run"
        played = run_python(
            [
                *("-m", "harness.cli", "run", str(_scenario_file(scenario, place)), "--backend", "sim"),
                *("--seed", str(self.subject.seed), "--out", str(run_dir)),
            ],
            first=[code],
            cwd=place,
            limit_s=self._limit_s,
        )
        if crashed := played.raised_in(code / "ucp"):
            return Outcome(subject=self.subject.in_words, crashed=crashed), run_dir
        return self._judged(played, run_dir, exact=True), run_dir

    def _as_processes(self, code: Path, scenario: Scenario, command: str, place: Path) -> tuple[Outcome, Path]:
        asked = _with_command(scenario, _words(command, code), self._speedup)
        run_dir = place / "run"
        played = run_python(
            [
                *("-m", "harness.cli", "run", str(_scenario_file(asked, place)), "--backend", "process"),
                *("--seed", str(self.subject.seed), "--out", str(run_dir)),
            ],
            first=[ROOT],
            cwd=place,
            limit_s=self._limit_s,
        )
        return self._judged(played, run_dir, exact=False), run_dir

    def _judged(self, played: Ended, run_dir: Path, *, exact: bool) -> Outcome:
        """By the judge that runs now, whichever state of the code was played. Raises CannotBeTriedError."""
        if played.status is None:
            raise CannotBeTriedError(f"it did not end within {self._limit_s:g} s; allow more time with --limit-s")
        said = played.last_words.replace(f"{run_dir.parent}/", "")
        if played.status == INTERRUPTED:
            raise InterruptedRunError("interrupted")
        archive = RunArchive(run_dir) if (run_dir / "run.json").is_file() else None
        if archive is not None and archive.record.outcome == "not supported":
            raise CannotBeTriedError(archive.record.outcome_detail or said)
        if played.status == CANNOT_HERE:
            raise MachineCannotError(said)
        if (
            played.status not in (0, VIOLATED, WRONG_REQUEST, INCOMPLETE)
            or archive is None
            or not archive.exports.by_agent
        ):
            raise CannotBeTriedError(said)
        return of_run(
            self.subject.in_words, checker.check(checker.gather(archive)), archive.exports.by_agent, exact=exact
        )

    # Records

    def _given_records(self, code: Path, place: Path) -> Outcome:
        if not (code / "ucp").is_dir():
            raise CannotBeTriedError("it has no directory ucp/")
        only = place / "core"
        only.mkdir()
        (only / "ucp").symlink_to(code.resolve() / "ucp", target_is_directory=True)
        whose = [] if self.subject.agent is None else [str(self.subject.agent)]
        played = run_python(
            ["-m", RECORD_CORE, str(self.subject.path), *whose],
            first=[only, ROOT],
            cwd=place,
            limit_s=self._limit_s,
        )
        if played.status is None:
            raise CannotBeTriedError(f"it did not end within {self._limit_s:g} s; allow more time with --limit-s")
        if crashed := played.raised_in(only / "ucp"):
            file = f"/{RECORD_CORE.replace('.', '/')}.py"
            if f'{file}"' in played.stderr and ", in main" in played.stderr:
                return Outcome(subject=self.subject.in_words, crashed=crashed)
            raise CannotBeTriedError(f"it does not start: {crashed}")
        try:
            document = json.loads(played.stdout) if played.status == 0 else {}
            agents = {
                int(agent): OfAgent(differences=[Difference.model_validate(each) for each in differences])
                for agent, differences in document["agents"].items()
            }
        except (ValueError, KeyError, TypeError):
            raise CannotBeTriedError(played.last_words) from None
        return Outcome(subject=self.subject.in_words, agents=agents)

    def _given_by_udp(self, code: Path, command: str, place: Path) -> Outcome:
        record = open_record(self.subject.path, self.subject.agent)
        words = _words(command, code)
        try:
            said = play_live(record, words, place, speedup=self._speedup or SPEEDUP)
        except NotStartedError as error:
            raise CannotBeTriedError(str(error)) from None
        except ReplayFailedError as error:
            return Outcome(subject=self.subject.in_words, crashed=str(error))
        return Outcome(subject=self.subject.in_words, agents={record.agent_id: OfAgent(differences=said)})


class MachineCannotError(HarnessError):
    """This machine cannot play it, whichever state of the code it is."""

    exit_status = CANNOT_HERE


def _scenario_file(scenario: Scenario, place: Path) -> Path:
    """The scenario without `expect`, and without what is as by default: another state of the code may not know it."""
    document = scenario.model_dump(mode="json", exclude_defaults=True, exclude={"expect"})
    file = place / "scenario.yaml"
    file.write_text(json.dumps(document), encoding="utf-8")  # JSON is YAML
    return file


def _with_command(scenario: Scenario, command: Sequence[str], speedup: float | None) -> Scenario:
    speed = {} if speedup is None else {"speedup": speedup}
    return scenario.model_copy(update={"agent_command": list(command), **speed})


def _words(command: str, code: Path) -> list[str]:
    """Raises HarnessError if the command is none."""
    try:
        words = [word.replace(CODE, str(code)) for word in shlex.split(command)]
    except ValueError as error:
        raise HarnessError(f"--agent-command {command!r} is not a command: {error}") from None
    if not words:
        raise HarnessError("--agent-command is empty: name a program, with its arguments")
    if shutil.which(words[0]) is None:
        raise CannotBeTriedError(f"there is no program {words[0]}")
    return words
