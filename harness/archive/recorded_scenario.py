"""Load the scenario that a command plays, from a scenario file or from the run.json of a run directory."""

from pathlib import Path

from harness.archive.archive import RunArchive
from harness.archive.exports import RUN_FILE
from harness.errors import ScenarioError
from harness.scenario import Scenario, load_scenario


def load_recorded_scenario(path: Path) -> tuple[Scenario, int | None]:
    """Return a scenario and its seed. `path` is a run directory, a scenario file, or the name of an included scenario.
    Only a run directory has a seed. Otherwise the seed is None. Raises HarnessError.
    """
    if not (path / RUN_FILE).is_file():
        return load_scenario(path), None
    archive = RunArchive(path)
    if archive.record_error is not None:
        raise archive.record_error
    if archive.record.scenario is None:
        raise ScenarioError(f"{path / RUN_FILE}: it does not name the scenario; give a scenario")
    return archive.record.scenario, archive.record.seed
