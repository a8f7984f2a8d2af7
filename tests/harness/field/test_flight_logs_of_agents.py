"""Test that each command assigns flight logs to the agents that flew on the same vehicles."""

import json
import re
from pathlib import Path

import pytest

from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import consolidate
from harness.field.depot.page import draw
from harness.field.depot.record_outputs import flight_logs, flown_tracks
from harness.field.flight_logs import read_flight_log
from harness.field.flight_logs._matching import Fixes, MatchedLog, changes, match_logs
from harness.field.replay._peer_messages import DeliveredMessage, estimate
from harness.report.logbook.positions import RoundedPosition
from tests.harness.command import harness, sentences
from tests.harness.field.flight_log_files import (
    BOOT_UTC_US,
    LAT_DEG,
    LON_DEG,
    dataflash,
    dataflash_file,
    flight_messages,
    telemetry_file,
    telemetry_messages,
)
from tests.harness.mission import write_exports
from tests.ucp.air import Air
from ucp.events import LoggableEvent
from ucp.telemetry import POSITION, Position

START_US = BOOT_UTC_US + 5_000_000
AHEAD_S = 2.5


def fixes(
    *, ahead_s: float = AHEAD_S, east_deg: float = 0.0, start_us: int = START_US, speed_ms: float = 10.0
) -> Fixes:
    """Return the positions that an agent logs on the flight of `flight_messages`, with times of its own clock."""
    return [
        (
            start_us + round((second + ahead_s) * 1e6),
            RoundedPosition(
                round((LAT_DEG + second * speed_ms / 111_320) * 1e7), round((LON_DEG + east_deg) * 1e7), 130_000
            ),
        )
        for second in range(2, 58, 4)
    ]


def matched(path: Path, agents: dict[int, Fixes], content: bytes | None = None) -> MatchedLog:
    path.write_bytes(dataflash_file() if content is None else content)
    (match,) = match_logs([read_flight_log(path)], agents)
    return match


def test_positions_decide_before_the_system_id(tmp_path: Path) -> None:
    agents = {7: fixes(east_deg=0.002), 32: fixes()}
    match = matched(tmp_path / "1.bin", agents)
    assert (match.vehicle.vehicle, match.agent_id) == (7, 32)
    assert match.clock_ahead_s == pytest.approx(AHEAD_S, abs=0.1)


def test_vehicle_ten_metres_beside_is_another_one(tmp_path: Path) -> None:
    agents = {32: fixes(east_deg=0.00013), 33: fixes()}
    assert matched(tmp_path / "1.bin", agents).agent_id == 33
    del agents[33]
    assert matched(tmp_path / "2.bin", agents).agent_id is None


def test_positions_match_a_telemetry_log(tmp_path: Path) -> None:
    start_us = 1_700_000_000_000_000
    agents = {5: fixes(start_us=start_us, ahead_s=-3.0), 7: fixes(start_us=start_us, east_deg=0.01)}
    match = matched(tmp_path / "1.tlog", agents, telemetry_file())
    assert match.agent_id == 5
    assert match.clock_ahead_s == pytest.approx(-3.0, abs=0.6)


def test_earlier_flight_along_the_same_path_matches_no_agent(tmp_path: Path) -> None:
    (tmp_path / "1.bin").write_bytes(dataflash_file())
    (tmp_path / "2.bin").write_bytes(dataflash_file(flight_messages(first_us=605_000_000)))
    logs = [read_flight_log(tmp_path / name) for name in ("1.bin", "2.bin")]
    earlier, later = match_logs(logs, {7: fixes(start_us=START_US + 600_000_000)})
    assert (earlier.agent_id, later.agent_id) == (None, 7)
    assert earlier.evidence == "it flew the path of agent 7 600 s earlier"


@pytest.mark.parametrize(
    ("agents", "agent_id", "evidence"),
    [
        ({7: []}, 7, "its system ID"),
        ({7: fixes(speed_ms=0.0)}, 7, "its system ID"),
        ({8: []}, None, "no agent has its system ID 7 or its positions"),
        ({7: fixes(east_deg=1.0)}, None, "agent 7 has its system ID, but flew 74"),
        ({7: fixes(ahead_s=200_000.0, speed_ms=0.0)}, None, "agent 7 has its system ID, but flew on another day"),
    ],
)
def test_system_id_decides_only_without_contradiction(
    agents: dict[int, Fixes], agent_id: int | None, evidence: str, tmp_path: Path
) -> None:
    match = matched(tmp_path / "1.bin", agents)
    assert match.agent_id == agent_id
    assert match.evidence.startswith(evidence)
    assert match.clock_ahead_s is None


def test_changes_of_gps_and_mode_are_in_time_order(tmp_path: Path) -> None:
    messages = [*flight_messages(seconds=5)]
    messages += [
        dataflash("GPS", 10_500_000, 0, 1, 10_010_500, 2446, 0, 9, LAT_DEG, LON_DEG, 0, 0, 0, 0, 0, 1),
        dataflash("GPS", 12_000_000, 0, 3, 10_012_000, 2446, 9, 1, LAT_DEG, LON_DEG, 0, 0, 0, 0, 0, 1),
    ]
    match = matched(tmp_path / "1.bin", {7: []}, dataflash_file(messages))
    words = [change.words for change in changes(match)]
    assert words == ["mode GUIDED", "armed", "mode LAND", "disarmed", "GPS without a fix", "GPS has a fix"]


@pytest.mark.parametrize(("reason", "name"), [(4, "battery failsafe"), (25, "failsafe")])
def test_failsafe_that_changed_the_mode_is_named(reason: int, name: str, tmp_path: Path) -> None:
    messages = [*flight_messages(seconds=5), dataflash("MODE", 12_000_000, 6, 6, reason)]
    words = [change.words for change in changes(matched(tmp_path / "1.bin", {7: []}, dataflash_file(messages)))]
    assert words[-1] == f"mode RTL, {name}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a directory with exports of agents 7 and 8, a flight log of agent 7's vehicle, and files of other
    programs.
    """
    directory = tmp_path_factory.mktemp("home")
    air = Air([7, 8])
    for agent_id in (7, 8):
        for at_us, place in fixes(east_deg=0.0 if agent_id == 7 else 0.003):
            position = Position(
                0, 0, place.lat_e7, place.lon_e7, 130_000, *[0] * 4, 0, *[0.0] * 3, *[0] * 3, 0, 0, 0, 4, 1
            )
            air.agents[agent_id].add_event(LoggableEvent(at_us, POSITION, position.pack()), air.now)
    air.settle()
    write_exports(air, directory, traces=False)
    (directory / "00000003.BIN").write_bytes(dataflash_file())
    (directory / "other.tlog").write_bytes(telemetry_file(telemetry_messages(vehicle=99)))
    (directory / "mission.plan").write_text('{"fileType": "Plan"}')
    return directory


def test_consolidation_shows_flight_logs_on_the_map_and_over_time(folder: Path) -> None:
    record = consolidate(collect_exports([folder]))
    matches = flight_logs(record)
    assert [(match.log.path.name, match.agent_id) for match in matches] == [("other.tlog", None), ("00000003.BIN", 7)]
    assert [(track.agent_id, len(track.fixes)) for track in flown_tracks(matches)] == [(7, 60)]
    page = draw(record)
    assert "flight log of vehicle 7" in page
    assert "Vehicles over time" in page and "mode GUIDED" in page and "disarmed" in page
    assert "is of agent 7 by 14 positions; the clock of agent 7 was +2." in page
    marks = re.findall(r'<path class="mark" [^>]*><title>(.*?)</title>', page)
    assert marks == ["mode GUIDED, armed", "mode LAND, disarmed"]
    assert "other.tlog: the telemetry log of a plane matches no agent" in page


def test_import_copies_flight_logs_and_names_the_others(folder: Path, tmp_path: Path) -> None:
    done = harness("import", folder, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "2 export(s), 1 flight log(s)" in done.stdout
    printed = " ".join(sentences(done.stderr))
    assert "00000003.BIN: the DataFlash log of a copter is of agent 7 by 14 positions" in printed
    assert "other.tlog: the telemetry log of a plane matches no agent" in printed
    assert "mission.plan" in printed
    record = json.loads((tmp_path / "out" / "import.json").read_text())
    (flight,) = record["flights"]
    (copy,) = flight["agents"]["7"]["flight_logs"]
    assert flight["agents"]["8"]["flight_logs"] == []
    assert (tmp_path / "out" / copy).read_bytes() == (folder / "00000003.BIN").read_bytes()


def test_gps_time_places_clocks_of_agents_without_messages() -> None:
    deliveries = [DeliveredMessage(1, 2, 10.0, 10.1), DeliveredMessage(2, 1, 20.0, 20.1)]
    assert estimate([1, 2, 3], deliveries)[3].offset_s == 0.0
    clocks = estimate([1, 2, 3], deliveries, {2: 0.5, 3: 4.0})
    assert clocks[3].offset_s - clocks[2].offset_s == pytest.approx(3.5)
    assert clocks[1].offset_s == pytest.approx(clocks[2].offset_s, abs=0.1)
