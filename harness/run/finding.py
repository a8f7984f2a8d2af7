"""What was found in a simulated run: how it is judged, what is said of it, and the file that plays it again."""

from collections.abc import Callable
from pathlib import Path

from harness.archive.directory import default_path
from harness.checker import Result
from harness.checker.judgement import Finding, Judgement
from harness.errors import AgentFailedError, MachineError, RunDirectoryError
from harness.gc_pause import gc_paused
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.scenario.verdict_names import CHARACTERISTICS

EVIDENCE_SHOWN = 5

Judge = Callable[[Scenario, int], Result]
"""Plays a scenario with a seed, and judges it."""


ENDED = "ended"
"""Key of what an agent is judged by that did not get to the end of its mission."""


@gc_paused()
def simulated(scenario: Scenario, seed: int) -> Result:
    """With traces, so that all six characteristics are judged; of a run that an agent ended, only that it did."""
    try:
        return simulate(scenario, seed, tracing=True).result
    except AgentFailedError as error:
        return ended_by(error)


def ended_by(error: AgentFailedError) -> Result:
    """An agent crashed or hung: there is no more to judge, and no less to find and to shrink."""
    finding = Finding(error.agent_id, f"{error.outcome}: it {error.detail}")
    judgement = Judgement("every agent to the end", "violated", f"agent {error.agent_id} {error.outcome}", [finding])
    return Result({}, {}, {ENDED: judgement})


def evidence_lines(violated: dict[str, Judgement]) -> list[str]:
    """What is violated, and how one sees it."""
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


def claim(out: Path | None, name: str) -> Path:
    """Where the file will be: `out`, or a new name under `runs`. Raises RunDirectoryError if there is one already."""
    if out is not None and out.exists():
        raise RunDirectoryError(f"{out} exists: choose another --out, nothing is overwritten")
    path = out or default_path(f"{name} shrunk").with_suffix(".yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunDirectoryError(f"{path.parent} cannot be made: {error.strerror}; choose another --out") from None
    return path


def write(path: Path, text: str) -> Path:
    """Where it was written: a number is added if somebody was faster. Raises MachineError."""
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
