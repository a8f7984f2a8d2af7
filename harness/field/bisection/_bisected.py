"""What is played again and again: a scenario, a run in virtual time, or records that came home."""

from dataclasses import dataclass
from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE
from harness.errors import ScenarioError
from harness.scenario import Scenario, load, load_scenario
from harness.scenario.load import MAX_SCENARIO_BYTES

YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class Subject:
    """`scenario` is None of records, which are in `path`; `agent` is whose record is meant, None for all."""

    path: Path
    scenario: Scenario | None
    seed: int
    agent: int | None = None

    @property
    def in_words(self) -> str:
        if self.scenario is None:
            return (
                f"the records in {self.path}" if self.agent is None else f"agent {self.agent}'s record in {self.path}"
            )
        return f"{self.path}, seed {self.seed}"


def subject_of(path: Path, seed: int | None, agent: int | None) -> Subject:
    """A YAML file, or a name of the library, is a scenario; so is a run directory of virtual time; all else is records.

    Raises HarnessError.
    """
    path = load.find(path)
    if path.suffix in YAML or (path.is_file() and _is_scenario(path)):
        scenario = load_scenario(path)
        own = scenario.expect.seeds[0] if scenario.expect else 1
        subject = Subject(path.resolve(), scenario, own if seed is None else seed)
    elif (path / RUN_FILE).is_file() and agent is None and (played := _played(path)) is not None:
        subject = Subject(path.resolve(), played[0], played[1] if seed is None else seed)
    else:
        if not path.exists():
            raise ScenarioError(f"{path}: there is no such file, directory or scenario")
        subject = Subject(path.resolve(), None, 0, agent)
    if subject.scenario is not None and agent is not None:
        raise ScenarioError("--agent chooses one of several records, and this is a scenario: leave it out")
    return subject


def _is_scenario(path: Path) -> bool:
    return path.stat().st_size <= MAX_SCENARIO_BYTES and path.read_bytes().lstrip()[:5] == b"name:"


def _played(path: Path) -> tuple[Scenario, int] | None:
    """Scenario and seed of a run that plays the same again."""
    record = RunArchive(path).record
    if record.backend != "sim" or record.scenario is None or record.seed is None:
        return None
    return record.scenario, record.seed
