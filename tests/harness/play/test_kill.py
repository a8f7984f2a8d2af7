"""Test that only the run directory remains if the harness is killed at any moment."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path
from random import Random

import pytest

from tests.harness.command import COMMAND, write_scenario

pytestmark = pytest.mark.lab

MOMENTS = 20
LAST_MOMENT_S = 3.5
"""Latest time of a kill, in seconds after the start of the run. The run takes about four seconds, including two seconds
for the mission.
"""
GONE_WITHIN_S = 10.0
MARK = "UCP_TEST_MARK"


def marked(mark: str) -> dict[int, str]:
    """Return the network namespace of each process whose environment has the mark of this run, by process ID."""
    wanted = f"{MARK}={mark}".encode()
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if wanted in (entry / "environ").read_bytes():
                    found[int(entry.name)] = str((entry / "ns/net").readlink())
    return found


def network_namespaces() -> set[str]:
    """Return all network namespaces that are in use."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                found.add(str((entry / "ns/net").readlink()))
                found |= {
                    target for fd in (entry / "fd").iterdir() if (target := str(fd.readlink())).startswith("net:")
                }
    mounts = Path("/proc/self/mountinfo").read_text().splitlines()
    return found | {line.split()[3] for line in mounts if " nsfs " in line}


def rules() -> str:
    """Return the firewall rules of this network namespace. Return an empty text if the user cannot read them."""
    nft = shutil.which("nft", path="/usr/sbin:/sbin:/usr/bin")
    if nft is None or os.geteuid() != 0:
        return ""
    return subprocess.run([nft, "list", "ruleset"], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("moment", range(MOMENTS))
def test_killed_run_leaves_nothing(moment: int, tmp_path: Path) -> None:
    after_s = Random(moment).uniform(moment, moment + 1) / MOMENTS * LAST_MOMENT_S
    interfaces, firewall = set(Path("/sys/class/net").iterdir()), rules()
    temporary = tmp_path / "tmp"
    work = tmp_path / "work"
    temporary.mkdir()
    work.mkdir()
    scenario = write_scenario(tmp_path, network={"loss": 0.2}, vehicles={"kind": "embedded"})
    mark = str(uuid.uuid4())
    run = subprocess.Popen(
        [*COMMAND, "run", str(scenario), "--out", str(tmp_path / "run")],
        cwd=work,
        env={**os.environ, MARK: mark, "TMPDIR": str(temporary), "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    namespaces = set()
    killed_at = time.monotonic() + after_s
    while (left_s := killed_at - time.monotonic()) > 0:
        time.sleep(min(left_s, 0.2))  # reading /proc more often would slow other tests down
        namespaces |= set(marked(mark).values())
    run.send_signal(signal.SIGKILL)
    run.wait()
    deadline = time.monotonic() + GONE_WITHIN_S
    while left := marked(mark):
        assert time.monotonic() < deadline, f"still there: {left}"
        time.sleep(0.02)
    lab_namespaces = namespaces - {str(Path("/proc/self/ns/net").readlink())}
    while still := lab_namespaces & network_namespaces():
        assert time.monotonic() < deadline, f"still there: {still}"
        time.sleep(0.02)
    assert set(Path("/sys/class/net").iterdir()) == interfaces
    assert rules() == firewall
    assert not list(temporary.iterdir())
    assert not list(work.iterdir())
    for export in (tmp_path / "run").glob("agents/*.chain.json"):
        json.loads(export.read_text())  # an export is complete, or absent
