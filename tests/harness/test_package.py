"""Test the built Python package: each build gives the same bytes, and the package works outside a clone and without
optional packages.

The tests do not download packages. They unpack the built wheel beside links to the packages that it requires, and run
the commands with these packages and the standard library only. The optional packages and the clone are not accessible.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path

import pytest

from docs.generate.json_schemas import texts
from harness.cli import COMMANDS
from harness.errors import CANNOT_HERE
from harness.scenario import load_scenario
from sitl.streams import release
from tests.harness import forks
from tests.harness.command import sentences

REPOSITORY = Path(__file__).parents[2]
OWN = "ucp-harness"
PACKAGES = ("harness", "netem", "sitl", "ucp")
DEADLINE_S = 60.0


def required(name: str, found: dict[str, Distribution]) -> dict[str, Distribution]:
    """Add a package and all packages that it requires to `found`, and return `found`."""
    if name not in found:
        found[name] = distribution(name)
        for line in found[name].requires or ():
            package = re.match(r"[\w.-]+", line)
            if package and ";" not in line:
                required(re.sub(r"[-_.]+", "-", package[0]).lower(), found)
    return found


def build(source: Path, target: str, directory: Path, *, umask: int) -> Path:
    """Build the "wheel" or the "sdist" from a source tree. Return the resulting file."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(directory)],
        cwd=source,
        check=True,
        capture_output=True,
        umask=umask,
    )
    (path,) = directory.iterdir()
    return path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(REPOSITORY, "wheel", tmp_path_factory.mktemp("wheel"), umask=0o022)


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(REPOSITORY, "sdist", tmp_path_factory.mktemp("sdist"), umask=0o022)


@pytest.fixture(scope="module")
def packages(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the unpacked wheel, and links to the packages that it requires."""
    directory = tmp_path_factory.mktemp("packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(directory)
    names = required(OWN, {})
    for module, owners in packages_distributions().items():
        for owner in {re.sub(r"[-_.]+", "-", owner).lower() for owner in owners} & {*names} - {OWN}:
            site = Path(str(names[owner].locate_file("")))
            for path in (site / module, *site.glob(f"{module}.*")):
                if path.exists():
                    (directory / path.name).symlink_to(path)
    for name in {*names} - {OWN}:
        metadata = Path(str(names[name]._path))  # type: ignore[attr-defined]
        (directory / metadata.name).symlink_to(metadata)
    (directory / "tests").symlink_to(REPOSITORY / "tests")  # for `tests.harness.forks`
    return directory


def test_wheel_built_from_the_source_distribution_is_identical(wheel: Path, sdist: Path, tmp_path: Path) -> None:
    shutil.unpack_archive(sdist, tmp_path)
    (source,) = tmp_path.iterdir()
    again = build(source, "wheel", tmp_path / "dist", umask=0o077)
    assert again.name == wheel.name
    assert again.read_bytes() == wheel.read_bytes()


def test_source_distribution_is_reproducible(sdist: Path, tmp_path: Path) -> None:
    assert build(REPOSITORY, "sdist", tmp_path, umask=0o077).read_bytes() == sdist.read_bytes()


def test_wheel_has_types_licences_and_schemas(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name for name in names if name.endswith("py.typed")} == {f"{package}/py.typed" for package in PACKAGES}
    licences = {name.partition("/licenses/")[2] for name in names if "/licenses/" in name}
    vendored = [path for root in ("docs", *PACKAGES) for path in (REPOSITORY / root).glob("**/vendor/*")]
    assert len(vendored) == 2
    assert licences == {"LICENSE", *(f"{path.relative_to(REPOSITORY)}/LICENSE" for path in vendored)}
    assert {*texts()} <= {*names}


@pytest.mark.parametrize(
    ("installed", "sent"), [("1.2.3", (1, 2, 3)), ("1.2.3rc1", (1, 2, 3)), ("1.3.dev7", (1, 3, 0)), ("2", (2, 0, 0))]
)
def test_embedded_vehicle_sends_any_version_of_the_package(installed: str, sent: tuple[int, int, int]) -> None:
    assert release(installed) == sent


WORKING = [
    "run small.yaml --backend sim --seed 1 --capture --out run",
    "run small.yaml --backend sim --seed 2 --out other",
    "scenarios",
    "tell run heal",
    "shell run 1 true",
    "runs .",
    "check run",
    "report run",
    "chain run",
    "packets run",
    "diff run other",
    "mission new --out missions --agents 3",
    "import run --out imported",
    "consolidate run --out record.jsonl",
    "replay run",
    "reconstruct run --out again.yaml",
    "calibrate run --out radio.yaml",
    "matrix matrix.yaml --out matrix",
    "explore perfect --seeds 1",
    "bisect perfect --good HEAD",
    "prove --agents 2 --blocks 1",
    "conformance --only 1",
    "coverage run --json extra",
    "join --new-secret lab.key",
    "doctor --help",
    "sitl path",
    "clean",
]
"""Commands that need no optional packages. Some contain a mistake, because an error takes less time than the work of
the command.
"""
NEEDS = {
    "run secure --backend sim": "secure",
    "run secure": "secure",
    "run loss_15 --backend sim --secured": "secure",
    "run loss_15 --backend sim --watch": "watch",
    "watch run": "watch",
    "packets run --bundle a.bundle": "secure",
    "chain run --depot-key a.key": "secure",
    "export run --mcap run.mcap": "export",
    "export run --perfetto run.pftrace": "export",
    "export run --rosbag bag": "export",
    "mission new --out sealed --agents 3 --keys home": "secure",
    "keys new home --agents 3": "secure",
    "matrix matrix.yaml --out far --scheduler tcp://127.0.0.1:1": "cluster",
    "matrix secured.yaml --out secured": "secure",
    "explore secure --seeds 1": "secure",
    "explore secure --runs 1": "secure",
    "prove --captured 2 --agents 2 --blocks 1": "secure",
    "validate run": "spec",
}
"""The extra (group of optional packages) that each command needs."""
SMALL = {"name": "small", "agents": 3, "duration_s": 100, "events": {"source": "random"}}
MATRIX = {"name": "small", "scenario": SMALL, "loss": [0.1], "seeds": 1, "backend": "sim"}


def test_each_command_works_or_names_the_missing_extra(packages: Path, tmp_path: Path) -> None:
    secured = {**MATRIX, "scenario": {**SMALL, "security": {"keys": "fresh"}}}
    for name, document in {"small": SMALL, "matrix": MATRIX, "secured": secured}.items():
        (tmp_path / f"{name}.yaml").write_text(json.dumps(document))  # JSON is YAML
    for command in (*WORKING, *NEEDS):
        ended = forks.call(command.split(), os.environ, tmp_path, "", DEADLINE_S, packages)
        said = sentences(ended.stderr)
        if extra := NEEDS.get(command):
            assert ended.returncode == CANNOT_HERE, (command, ended)
            assert said[-1].endswith(f"run `pip install 'ucp-harness[{extra}]'`"), (command, ended)
            assert len(said) == 1, (command, ended)
        else:
            assert "pip install" not in f"{ended.stdout}{ended.stderr}", (command, ended)
    assert {command.split()[0] for command in (*WORKING, *NEEDS)} == {*COMMANDS}


SIMULATE = """
import sys
from pathlib import Path
from harness.errors import HarnessError
from harness.run.simulate import simulate
from harness.scenario import load_scenario

for name in sys.argv[1:]:
    try:
        print(name, "bad" if simulate(load_scenario(Path(name)), 1, tracing=True).result.bad else "good")
    except HarnessError as error:
        print(name, error.exit_status, error)
"""


def test_each_scenario_plays_or_names_the_missing_extra(packages: Path, tmp_path: Path) -> None:
    names = [path.stem for path in sorted((REPOSITORY / "scenarios").glob("*.yaml"))]
    scenarios = [name for name in names if not name.endswith("_matrix")]
    played = subprocess.run(
        [sys.executable, "-S", "-c", SIMULATE, *scenarios],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(packages)},
        capture_output=True,
        text=True,
        check=True,
    )
    results = dict(line.split(" ", 1) for line in played.stdout.splitlines())
    assert [*results] == scenarios
    for name, result in results.items():
        if load_scenario(Path(name)).security is None:
            assert result in ("good", "bad"), (name, result)
        else:
            assert result.startswith("3 ") and result.endswith("[secure]'`"), (name, result)
