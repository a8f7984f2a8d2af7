from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.sitl.real_flight import track_of


@pytest.mark.ardupilot
@pytest.mark.parametrize("by", ["mission", "guided"])
def test_a_real_copter_flies_its_plan(by: str, tmp_path: Path) -> None:
    """In a network namespace of its own: ArduPilot listens on every address and may send multicast."""
    if "ARDUPILOT_SITL" not in os.environ:
        pytest.skip("no ArduPilot: set ARDUPILOT_SITL to the directory that holds an arducopter")
    network = "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec"
    inside = ["unshare", "--user", "--map-root-user", "--net", "sh", "-c", f'{network} "$@"', "sh"]
    flight = [sys.executable, "-m", "tests.sitl.real_flight", str(tmp_path), by]
    flown = subprocess.run([*inside, *flight], capture_output=True, text=True, timeout=300, check=False)
    if flown.returncode != 0 and "unshare" in flown.stderr:
        pytest.skip(f"no network namespace to be had here: {flown.stderr.strip()}")
    assert flown.returncode == 0, flown.stderr
    track = track_of(tmp_path / "3.tlog")
    assert max(north_m for _, north_m, _, _ in track) == pytest.approx(100, abs=5)
    assert max(up_m for *_, up_m in track) == pytest.approx(20, abs=2)
    assert track[-1][3] < 2
