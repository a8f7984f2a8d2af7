from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sitl.airframes import BINARIES
from sitl.plan import By
from sitl.track import track
from sitl.vehicle import VEHICLE_TYPES, VehicleType
from tests.sitl.flying import HOME
from tests.sitl.real_flight import PLANS, track_of

WAYS: list[By] = ["mission", "guided"]
LATE_S, APART_M = 5.0, 6.0  # copters and rovers: maximum delay in seconds, and maximum distance at this time in metres
# Planes: maximum distance at the same second, and from the path over the ground, in metres.
PLANE_APART_M, PLANE_BESIDE_M = 80.0, 40.0


@pytest.mark.ardupilot
@pytest.mark.parametrize("by", WAYS)
@pytest.mark.parametrize("vehicle_type", VEHICLE_TYPES)
def test_real_vehicle_follows_the_computed_track(vehicle_type: VehicleType, by: By, tmp_path: Path) -> None:
    """Fly in a separate network namespace, because ArduPilot listens on every address and may send multicasts."""
    program, directory = BINARIES[vehicle_type], os.environ.get("ARDUPILOT_SITL")
    if directory is None:
        pytest.skip(f"no ArduPilot: set ARDUPILOT_SITL to the directory that holds an {program}")
    if not (Path(directory) / program).exists():
        pytest.skip(f"no {program} in {directory}, which ARDUPILOT_SITL names")
    network = "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec"
    inside = ["unshare", "--user", "--map-root-user", "--net", "sh", "-c", f'{network} "$@"', "sh"]
    flight = [sys.executable, "-m", "tests.sitl.real_flight", str(tmp_path), vehicle_type, by]
    flown = subprocess.run([*inside, *flight], capture_output=True, text=True, timeout=300, check=False)
    if flown.returncode != 0 and "unshare" in flown.stderr:
        pytest.skip(f"no network namespace to be had here: {flown.stderr.strip()}")
    assert flown.returncode == 0, flown.stderr
    computed = track(vehicle_type, PLANS[vehicle_type], heading_deg=HOME.heading_deg, by=by)
    places = track_of(tmp_path / "3.tlog", float(flown.stdout))
    path = [computed.at(quarter / 4)[:2] for quarter in range(4 * round(places[-1][0]))]
    late = [tenth / 10 for tenth in range(round(-10 * LATE_S), round(10 * LATE_S) + 1)]
    for second, place in places:
        when = f"{second:.1f} s after it was told to fly"
        if vehicle_type == "plane":
            assert math.dist(place, computed.at(second)) < PLANE_APART_M, when
            assert min(math.dist(place[:2], near) for near in path) < PLANE_BESIDE_M, when
        else:
            assert min(math.dist(place, computed.at(second + late_s)) for late_s in late) < APART_M, when
    assert places[-1][1][2] < 2
