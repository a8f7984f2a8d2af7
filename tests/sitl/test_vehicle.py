from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from sitl.embedded import Embedded
from sitl.vehicle import METRES_PER_DEGREE, Home, VehicleError, VehicleKind, home_in_field, place_in_field
from tests.sitl.flying import HOME


def metres_apart(a: Home, b: Home) -> float:
    east = (a.lon_deg - b.lon_deg) * math.cos(math.radians(a.lat_deg))
    return math.hypot(a.lat_deg - b.lat_deg, east) * METRES_PER_DEGREE


def test_hundred_homes_are_apart_and_in_one_field() -> None:
    homes = [home_in_field(index, HOME) for index in range(100)]
    assert homes[0] == HOME
    closest = min(metres_apart(a, b) for at, a in enumerate(homes) for b in homes[:at])
    assert closest > 4.0
    assert max(metres_apart(HOME, home) for home in homes) < 60.0


def test_homes_follow_spacing_and_centre_of_the_field() -> None:
    homes = [home_in_field(index, HOME, 50.0) for index in range(20)]
    assert min(metres_apart(a, b) for at, a in enumerate(homes) for b in homes[:at]) > 40.0
    for index, home in enumerate(homes):
        assert HOME.metres_to(home.lat_deg, home.lon_deg, 584.0)[:2] == pytest.approx(place_in_field(index, 50.0))


def test_home_at_zero_degrees_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match="vehicle 3: a home at 0,0 is ArduPilot's word for no position"):
        Embedded().launch(3, Home(0.0, 0.0), 1.0, tmp_path)


def test_home_parses_its_own_text() -> None:
    assert Home.parse(str(HOME)) == HOME


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "LAT,LON,ALT,HDG"),
        ("1,2,3", "LAT,LON,ALT,HDG"),
        ("1,2,3,4,5", "LAT,LON,ALT,HDG"),
        ("north,2,3,4", "LAT,LON,ALT,HDG"),
        ("91,2,3,4", "latitude 91"),
        ("1,181,3,4", "longitude 181"),
        ("1,2,3,360", "heading 360"),
        ("nan,2,3,4", "finite"),
        ("1,2,inf,4", "finite"),
    ],
)
def test_invalid_home_is_named(text: str, problem: str) -> None:
    with pytest.raises(VehicleError, match=problem):
        Home.parse(text)


def test_home_at_the_date_line_stays_valid() -> None:
    assert Home(0.0, 179.9999999).offset(0.0, 100.0).lon_deg < -179.9


def test_embedded_vehicle_starts_this_interpreter(tmp_path: Path) -> None:
    kind: VehicleKind = Embedded("plane")
    launch = kind.launch(7, HOME, 20.0, tmp_path)
    assert (kind.name, kind.vehicle_type) == ("embedded", "plane")
    assert launch.argv[0] == sys.executable
    assert f"--home={HOME}" in launch.argv
    assert launch.argv[launch.argv.index("--type") + 1] == "plane"
    assert (launch.pilot_port, launch.agent_port) == (5760, 5762)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("sysid", "speedup"), [(0, 1.0), (256, 1.0), (1, 0.0), (1, -1.0), (1, math.nan)])
def test_impossible_vehicle_is_refused(sysid: int, speedup: float, tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match=f"vehicle {sysid}"):
        Embedded().launch(sysid, HOME, speedup, tmp_path)
