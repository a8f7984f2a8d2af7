"""A project may have folders of the same names as the harness's packages: its tests of swarms run all the same."""

import subprocess
import sys
from pathlib import Path

TESTS = """
def test_swarm(swarm):
    swarm.run_for(10)

def test_of_its_own():
    import ucp.flight
"""


def in_a_project(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=120)


def test_a_project_with_packages_named_as_ours(tmp_path: Path) -> None:
    for name in ("harness", "ucp", "sitl"):
        (tmp_path / name).mkdir()
    for name in ("harness", "ucp"):  # a folder that is no package is in nobody's way
        (tmp_path / name / "__init__.py").touch()
    (tmp_path / "ucp/flight.py").touch()
    (tmp_path / "test_it.py").write_text(TESTS)
    played = in_a_project(tmp_path)
    assert "1 failed, 1 passed, 1 warning" in played.stdout, played.stdout + played.stderr
    assert "No module named 'ucp.flight'" in played.stdout
    assert f"tests cannot import harness and ucp of {tmp_path}: ucp-harness has packages of the same name" in " ".join(
        played.stdout.split()
    )
    without = in_a_project(tmp_path, "-p", "no:ucp-harness", "-k", "own")
    assert "1 passed, 1 deselected" in without.stdout, without.stdout + without.stderr
    taken = in_a_project(tmp_path, "-p", "ucp.flight")
    assert taken.returncode == 4
    assert taken.stderr.count("\n") <= 3
    assert f"the package ucp of {tmp_path / 'ucp'} is loaded already" in taken.stderr
