"""Test `ucp-harness chain`, which prints chains as text, JSON, GeoJSON and KML."""

import base64
import json
import random
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from harness.archive.archive import RunArchive
from harness.archive.exports import ExportedBlock, ExportMaker
from harness.report import logbook
from harness.report.logbook import Logbook
from harness.report.logbook.logbook_text import document, lines
from harness.report.logbook.positions import LAST_TIMESTAMP_US, EventTrack, geojson, kml, tracks
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.mission import CONNECTED, edit, edit_lines, fly, write_exports, write_run
from tests.ucp.air import Air
from tests.ucp.test_telemetry import frames, good_estimate, heartbeat, position_msg, text
from ucp.events import LoggableEvent, decode_events
from ucp.telemetry import EVENT_KINDS, POSITION, STATUS_TEXT, WAYPOINT, Position, TelemetryEvents

EPOCH_US = 1_795_258_278_000_000  # 2026-11-21 10:51:18 UTC
KML = {"kml": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
FLOWN = {
    "backend": "process",
    "scenario": {"name": "flown", "events": {"source": "mavlink"}, "vehicles": {"kind": None}},
}


def fly_vehicles(agents: int = 3, seconds: int = 240) -> Air:
    """Play agents that log telemetry. Their vehicles fly east side by side and reach a waypoint each minute."""
    air = Air(range(1, agents + 1))
    sources = {agent_id: TelemetryEvents(10.0, random.Random(agent_id), EVENT_KINDS) for agent_id in air.agents}
    for second in range(seconds):
        air.run_until(float(second))
        for agent_id, source in sources.items():
            messages = [
                good_estimate(),
                heartbeat(4, armed=second > 2),
                position_msg(1000 * second, 500_000_000 + agent_id, 80_000_000 + second),
            ]
            if second % 60 == 30:
                messages.append(mavlink.MAVLink_mission_item_reached_message(second // 60))
            if second == 100:
                messages.append(text("<EKF> & \x1b[31mGPS"))
            for event_id, data in source.receive(frames(*messages), float(second)):
                event = LoggableEvent(EPOCH_US + 1_000_000 * second, event_id, data)
                air.agents[agent_id].add_event(event, air.now)
            air.flush(agent_id)
    air.settle()
    return air


@pytest.fixture(scope="module")
def flown() -> Air:
    return fly_vehicles()


@pytest.fixture
def run_dir(flown: Air, tmp_path: Path) -> Path:
    return write_run(flown, tmp_path / "run", CONNECTED, **FLOWN)


def first_position(air: Air, agent_id: int) -> Position:
    ours = next(block for block in air.agents[1].state.chain if block.agent_id == agent_id)
    return Position.unpack(next(e.data for e in decode_events(ours.event_data) if e.event_id == POSITION))


# As text


def test_chain_prints_each_block_of_each_agent(flown: Air, run_dir: Path) -> None:
    done = harness("chain", run_dir)
    assert (done.returncode, done.stderr) == (0, "")
    printed = done.stdout.splitlines()
    chain = flown.agents[1].state.chain
    heads = [line for line in printed if not line.startswith(" ")]
    assert heads == [
        f"agent {agent_id}: a chain of {len(chain)} blocks, top {chain.top_chain_hash.hex()[:12]}"
        for agent_id in (1, 2, 3)
    ]
    (first, *_) = chain
    events = len(decode_events(first.event_data))
    assert printed[1].split() == [
        f"{first.agent_id}.1",
        *("2026-11-21", printed[1].split()[2], "UTC"),
        first.block_hash.hex()[:12],
        *(str(events), "events"),
    ]


def test_decode_prints_a_line_for_each_event(flown: Air, run_dir: Path) -> None:
    done = harness("chain", run_dir, "--decode", "--agent", "2")
    assert done.returncode == 0
    assert "agent 1:" not in done.stdout
    events = sum(len(decode_events(block.event_data)) for block in flown.agents[2].state.chain)
    assert len(done.stdout.splitlines()) == 1 + len(flown.agents[2].state.chain) + events
    assert "    2026-11-21 10:51:48.000 UTC  [30.0 s] reached mission item 0\n" in done.stdout
    assert "] info: <EKF> & ?[31mGPS\n" in done.stdout
    assert "\x1b" not in done.stdout


def test_decoded_events_have_mission_seconds_and_names_of_modes(flown: Air, run_dir: Path) -> None:
    def begin(lines: list[dict[str, Any]]) -> None:
        lines[0]["clock"]["epoch_us"] = EPOCH_US

    for trace in (run_dir / "agents").glob("*.trace.jsonl"):
        edit_lines(trace, begin)
    printed = harness("chain", run_dir, "--decode", "--agent", "2").stdout
    assert "        30.0 s  2026-11-21 10:51:48.000 UTC  [30.0 s] reached mission item 0\n" in printed
    assert "armed in mode GUIDED\n" in printed and ", mode GUIDED armed\n" in printed
    (first, *_) = json.loads(harness("chain", run_dir, "--json").stdout)["agents"]["2"]["chain"]
    assert first["mission_s"] == (first["timestamp_us"] - EPOCH_US) / 1e6


def test_exports_without_a_run_are_decoded_as_telemetry(flown: Air, tmp_path: Path) -> None:
    paths = write_exports(flown, tmp_path, traces=False)
    assert "reached mission item" in harness("chain", paths[0], "--decode").stdout


def test_events_of_no_vehicle_are_printed_as_bytes(tmp_path: Path) -> None:
    """Random events are printed as bytes, even if their ID and length are those of telemetry."""
    air = Air([1])
    for _ in range(40):
        air.agents[1].add_event(LoggableEvent(5_000_000, WAYPOINT, bytes(6)), air.now)
        air.agents[1].add_event(LoggableEvent(6_000_000, 200, bytes(range(32))), air.now)
    air.settle()
    simulated = {
        "backend": "sim",
        "scenario": {"name": "flown", "events": {"source": "mavlink"}, "vehicles": {"kind": None}},
    }
    done = harness("chain", write_run(air, tmp_path / "run", CONNECTED, **simulated), "--decode")
    assert "    5.000 s  event 6, 6 bytes: 000000000000\n" in done.stdout
    assert "    6.000 s  event 200, 32 bytes: 0001020304050607…\n" in done.stdout
    assert "reached" not in done.stdout


@pytest.mark.parametrize(
    "change",
    [
        {"backend": "sim"},
        {"scenario": {"name": "flown", "events": {"source": "random"}, "vehicles": {"kind": None}}},
        {"scenario": {"name": "flown", "events": {"source": "mavlink"}, "vehicles": {"kind": "none"}}},
    ],
)
def test_record_decides_whether_events_are_telemetry(flown: Air, tmp_path: Path, change: dict[str, Any]) -> None:
    assert logbook.read(RunArchive(write_run(flown, tmp_path / "flown", CONNECTED, **FLOWN))).telemetry
    assert not logbook.read(RunArchive(write_run(flown, tmp_path / "not", CONNECTED, **{**FLOWN, **change}))).telemetry
    assert not logbook.read(RunArchive(tmp_path / "not" / "agents" / "2.chain.json")).telemetry


def test_chains_of_a_simulated_run_are_printed(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(json.dumps({"name": "x", "agents": 2, "duration_s": 400}))
    assert harness("run", scenario, "--backend", "sim", "--seed", "1", "--out", tmp_path / "run").returncode == 0
    done = harness("chain", tmp_path / "run", "--decode")
    assert done.returncode == 0
    assert done.stdout.count("agent ") == 2
    assert " bytes: " in done.stdout
    assert "unreadable" not in done.stdout


def test_blocks_outside_the_chain_are_counted(run_dir: Path) -> None:
    def move(export: dict[str, Any]) -> None:
        export["blocks_to_be_committed"] = [{**export["chain"].pop(), "chain_hash": None}]

    edit(run_dir / "agents" / "1.chain.json", move)
    assert "  beside the chain: 1 block to be committed\n" in harness("chain", run_dir).stdout


def test_unreadable_events_of_a_block_are_reported_with_their_place(run_dir: Path) -> None:
    def cut(export: dict[str, Any]) -> None:
        export["chain"][0]["event_data"] = base64.b64encode(bytes(5)).decode()

    edit(run_dir / "agents" / "1.chain.json", cut)
    done = harness("chain", run_dir, "--agent", "1", "--decode")
    assert done.returncode == 0
    assert done.stdout.splitlines()[1].endswith("unreadable events")
    assert done.stdout.splitlines()[2] == "    unreadable: event header at byte 0 is cut off"
    as_json = json.loads(harness("chain", run_dir, "--agent", "1", "--json").stdout)
    assert as_json["agents"]["1"]["chain"][0]["events"] is None


# As JSON


def test_json_holds_every_block_and_event(flown: Air, run_dir: Path) -> None:
    plain = json.loads(harness("chain", run_dir, "--json").stdout)
    assert list(plain["agents"]) == ["1", "2", "3"]
    assert plain["source"] == "mavlink"
    assert plain["errors"] == []
    printed = plain["agents"]["3"]["chain"]
    assert [block["block_hash"] for block in printed] == [
        block.block_hash.hex() for block in flown.agents[3].state.chain
    ]
    for block, ours in zip(printed, flown.agents[3].state.chain, strict=True):
        events = [LoggableEvent(e["timestamp_us"], e["event_id"], bytes.fromhex(e["data"])) for e in block["events"]]
        assert events == decode_events(ours.event_data)
    assert "words" not in printed[0]["events"][0]
    in_words = json.loads(harness("chain", run_dir, "--json", "--decode").stdout)
    assert in_words["agents"]["3"]["chain"][0]["events"][0]["words"] == "[0.0 s] mode GUIDED"


# Missing, damaged or hostile input


def test_missing_export_of_an_agent_causes_one_sentence(run_dir: Path) -> None:
    (run_dir / "agents" / "2.chain.json").unlink()
    edit(run_dir / "run.json", lambda run: run["agents"].update({"2": {"outcome": "killed"}}))
    done = harness("chain", run_dir)
    assert done.returncode == 0
    assert sentences(done.stderr) == ["agent 2 has no export here (killed)"]
    assert done.stdout.count("agent ") == 2
    asked = harness("chain", run_dir, "--agent", "2")
    assert (asked.returncode, asked.stdout) == (2, "")
    assert sentences(asked.stderr) == ["agent 2 has no export here (killed); exports here are of agents 1, 3"]
    stranger = harness("chain", run_dir, "--agent", "9")
    assert stranger.returncode == 2
    assert sentences(stranger.stderr) == ["the export of agent 9 is missing; exports here are of agents 1, 3"]


def test_damaged_export_has_status_2_and_the_rest_are_printed(run_dir: Path) -> None:
    path = run_dir / "agents" / "2.chain.json"
    path.write_text(path.read_text()[:500])
    done = harness("chain", run_dir)
    assert done.returncode == 2
    assert any(str(path) in sentence and "truncated or damaged" in sentence for sentence in sentences(done.stderr))
    assert "agent 1: " in done.stdout


def test_chain_command_without_exports_has_status_2(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        done = harness("chain", path)
        assert done.returncode == 2
        assert str(path) in sentences(done.stderr)[0]


@pytest.mark.parametrize("record", ["", "[]", '{"roster": 7}', "[" * 100_000])
def test_chains_are_read_without_a_valid_record(run_dir: Path, record: str) -> None:
    (run_dir / "run.json").write_text(record)
    assert list(logbook.read(RunArchive(run_dir)).exports) == [1, 2, 3]


@pytest.mark.parametrize("option", ["--decode", "--json"])
def test_closed_standard_output_ends_the_command_quietly(tmp_path: Path, option: str) -> None:
    """The output is longer than the buffer of a pipe. Therefore the command notices that the reader has closed the
    pipe.
    """
    run = write_run(fly(agents=5, duration_s=12_000), tmp_path / "run", CONNECTED)
    with subprocess.Popen(
        [*COMMAND, "chain", str(run), option], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(DEADLINE_S) == 0


def test_character_that_the_terminal_lacks_is_a_question_mark(flown: Air, tmp_path: Path) -> None:
    air = Air([1])
    for _ in range(20):
        data = b"\0\0\0\0\6" + "Höhe →".encode()
        air.agents[1].add_event(LoggableEvent(1, STATUS_TEXT, data + bytes(100)), air.now)
    air.settle()
    paths = write_exports(air, tmp_path, traces=False)
    done = harness("chain", paths[0], "--decode", env={"PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stderr) == (0, "")
    assert "info: H?he ?" in done.stdout


any_events = st.lists(
    st.tuples(st.integers(0, 2**64 - 1), st.integers(1, 254) | st.integers(1, 9), st.binary(max_size=80)), max_size=6
).map(lambda events: b"".join(LoggableEvent(*event).encode() for event in events))
any_blocks = st.lists(
    st.tuples(st.integers(1, 3), st.integers(0, 2**64 - 1), any_events | st.binary(max_size=200)), max_size=5
)


@given(any_blocks, st.booleans())
def test_any_block_is_printed_and_mapped(flown: Air, blocks: list[tuple[int, int, bytes]], telemetry: bool) -> None:
    export = (
        logbook_of(flown)
        .exports[1]
        .model_copy(
            update={
                "chain": [
                    ExportedBlock(
                        agent_id=agent_id,
                        timestamp_us=timestamp_us,
                        event_data=base64.b64encode(event_data).decode(),
                        block_hash="0" * 64,
                        chain_hash="0" * 64,
                    )
                    for agent_id, timestamp_us, event_data in blocks
                ]
            }
        )
    )
    book = Logbook({1: export}, {}, telemetry)
    assert all(line.isprintable() for line in lines(book, decode=True))
    json.dumps(document(book, decode=True), allow_nan=False)
    found = tracks(book)
    check_geojson(json.loads(json.dumps(geojson(found), allow_nan=False)))
    ElementTree.fromstring(kml(found))  # noqa: S314 (our own)


def fixes(book: Logbook) -> list[list[tuple[int, bytes]]]:
    """Return the positions of each track as bytes. Unknown angles are NaN, which is not equal to itself."""
    return [[(timestamp_us, position.pack()) for timestamp_us, position in track.fixes] for track in tracks(book)]


def logbook_of(air: Air) -> Logbook:
    maker = ExportMaker()
    exports = {agent_id: maker.export(agent.state, 0) for agent_id, agent in air.agents.items()}
    return Logbook(exports, {})


# On maps


def check_geojson(collection: dict[str, Any]) -> None:
    """Check that these features follow the rules of RFC 7946."""
    assert collection["type"] == "FeatureCollection"
    for feature in collection["features"]:
        assert feature["type"] == "Feature"
        assert isinstance(feature["properties"], dict)
        geometry = feature["geometry"]
        if geometry is None:
            continue
        points = geometry["coordinates"] if geometry["type"] == "LineString" else [geometry["coordinates"]]
        assert geometry["type"] == "Point" or len(points) >= 2
        for lon, lat, _ in points:
            assert -180 <= lon <= 180
            assert -90 <= lat <= 90


def test_geojson_has_a_line_for_each_vehicle_and_a_point_for_each_event(
    flown: Air, run_dir: Path, tmp_path: Path
) -> None:
    file = tmp_path / "map.geojson"
    done = harness("chain", run_dir, "--geojson", file)
    assert (done.returncode, done.stderr) == (0, "")
    collection = json.loads(file.read_text())
    check_geojson(collection)
    features = collection["features"]
    tracks_drawn = [one for one in features if one["geometry"] and one["geometry"]["type"] == "LineString"]
    assert [one["properties"]["agent"] for one in tracks_drawn] == [1, 2, 3]
    for one in tracks_drawn:
        times = one["properties"]["times"]
        assert len(times) == len(one["geometry"]["coordinates"]) > 10
        assert times == sorted(times)
    position = first_position(flown, 2)
    at = [position.lon_e7 / 1e7, position.lat_e7 / 1e7, position.alt_mm / 1e3]
    assert tracks_drawn[1]["geometry"]["coordinates"][0] == at
    assert at[1] == pytest.approx(50.0)  # longitude comes first
    positions = sum(len(one["geometry"]["coordinates"]) for one in tracks_drawn)
    assert done.stdout == f"{positions} positions of 3 vehicles: {file}\n"
    blocks = flown.agents[1].state.chain
    assert len(features) - 3 == sum(len(decode_events(block.event_data)) for block in blocks)


def test_event_has_the_last_position_of_its_vehicle(flown: Air) -> None:
    features = [one for one in geojson(tracks(logbook_of(flown)))["features"] if "event_id" in one["properties"]]
    first, *_ = features
    assert first["properties"] == {
        "agent": 1,
        "block": first["properties"]["block"],
        "time": "2026-11-21T10:51:18.000Z",
        "event_id": 1,
        "words": "[0.0 s] mode GUIDED",
        "position_age_s": None,
    }
    assert first["geometry"] is None
    reached = next(one for one in features if one["properties"]["event_id"] == WAYPOINT)
    before = [one for one in features[: features.index(reached)] if one["properties"]["event_id"] == POSITION]
    assert reached["geometry"] == before[-1]["geometry"]
    assert 0 < reached["properties"]["position_age_s"] < 16


def test_map_shows_a_lost_vehicle_by_the_blocks_that_others_hold(flown: Air) -> None:
    book = logbook_of(flown)
    whole = fixes(book)
    del book.exports[3]
    assert len(whole) == 3
    assert fixes(book) == whole


def test_blocks_in_any_order_and_number_of_copies_give_one_track(flown: Air) -> None:
    book = logbook_of(flown)
    export = book.exports[1]
    outside = [block.model_copy(update={"chain_hash": None}) for block in export.chain]
    stacked = export.model_copy(update={"chain": [], "reconcile_stack": outside[::-1]})
    waiting = export.model_copy(update={"chain": [], "blocks_to_be_committed": outside})
    assert fixes(Logbook({1: stacked, 2: waiting}, {})) == fixes(book)


def test_impossible_positions_and_times_are_left_out(flown: Air) -> None:
    good = first_position(flown, 1)
    made = [
        LoggableEvent(1, POSITION, good.pack()),
        LoggableEvent(2, POSITION, good._replace(lat_e7=900_000_001).pack()),
        LoggableEvent(3, POSITION, good._replace(lon_e7=-1_800_000_001).pack()),
        LoggableEvent(LAST_TIMESTAMP_US, POSITION, good.pack()),
        LoggableEvent(LAST_TIMESTAMP_US + 1, POSITION, good.pack()),
    ]
    export = logbook_of(flown).exports[1]
    block = export.chain[0].model_copy(
        update={"event_data": base64.b64encode(b"".join(event.encode() for event in made)).decode()}
    )
    (track,) = tracks(Logbook({1: export.model_copy(update={"chain": [block]})}, {}))
    assert [timestamp_us for timestamp_us, _ in track.fixes] == [1, LAST_TIMESTAMP_US]
    assert geojson([track])["features"][0]["properties"]["times"] == [
        "1970-01-01T00:00:00.000Z",
        "9999-12-31T23:59:59.999Z",
    ]


def test_single_position_is_a_point_and_no_line(flown: Air) -> None:
    (track, *_) = tracks(logbook_of(flown))
    entry = next(entry for entry in track.entries if entry.is_position)
    alone = EventTrack(1, [entry], track.fixes[:1])
    (feature,) = geojson([alone])["features"]
    assert feature["geometry"]["type"] == "Point"
    assert kml([alone]).count("<gx:coord>") == 1


def test_kml_has_a_track_and_placemarks_with_times(flown: Air, run_dir: Path, tmp_path: Path) -> None:
    file = tmp_path / "map.kml"
    assert harness("chain", run_dir, "--kml", file).returncode == 0
    root = ElementTree.parse(file).getroot()  # noqa: S314 (our own)
    assert root.tag == f"{{{KML['kml']}}}kml"
    folders = root.findall("kml:Document/kml:Folder", KML)
    assert [folder.findtext("kml:name", None, KML) for folder in folders] == ["vehicle 1", "vehicle 2", "vehicle 3"]
    for folder in folders:
        (track,) = folder.findall("kml:Placemark/gx:Track", KML)
        times, coords = track.findall("kml:when", KML), track.findall("gx:coord", KML)
        assert len(times) == len(coords) > 10
        assert track.findtext("kml:altitudeMode", None, KML) == "absolute"
        lon, lat, alt = map(float, (coords[0].text or "").split(" "))
        assert (lon, lat, alt) == (pytest.approx(8.0, abs=0.001), pytest.approx(50.0, abs=0.001), 604.0)
    marks = [one for one in folders[0].findall("kml:Placemark", KML) if one.find("kml:Point", KML) is not None]
    names = [one.findtext("kml:name", None, KML) for one in marks]
    assert "[30.0 s] reached mission item 0" in names
    assert "[100.0 s] info: <EKF> & ?[31mGPS" in names
    assert not any(" at " in str(name) for name in names)  # positions are the track
    assert marks[0].findtext("kml:TimeStamp/kml:when", "", KML).startswith("2026-11-21T10:51:")
    assert len((marks[0].findtext("kml:Point/kml:coordinates", "", KML)).split(",")) == 3


def test_map_files_are_not_overwritten(run_dir: Path, tmp_path: Path) -> None:
    file = tmp_path / "map"
    file.write_text("mine")
    for option in ("--geojson", "--kml"):
        done = harness("chain", run_dir, option, file)
        assert done.returncode == 2
        assert sentences(done.stderr) == [f"{file} exists: choose another file; existing files are not overwritten"]
        assert file.read_text() == "mine"
    done = harness("chain", run_dir, "--kml", tmp_path / "nowhere" / "map.kml")
    assert done.returncode == 2
    assert "cannot be created: No such file or directory" in sentences(done.stderr)[0]


def test_chains_without_positions_give_no_map(tmp_path: Path) -> None:
    run = write_run(fly(agents=2), tmp_path / "run", CONNECTED, **{**FLOWN, "backend": "sim"})
    done = harness("chain", run, "--geojson", tmp_path / "map")
    assert done.returncode == 2
    assert "the events are not of vehicles" in sentences(done.stderr)[0]
    assert not (tmp_path / "map").exists()


def test_map_of_a_run_in_virtual_time_shows_its_recorded_tracks(tmp_path: Path) -> None:
    run = write_run(fly(agents=2), tmp_path / "run", CONNECTED, **{**FLOWN, "backend": "sim"})
    places = ({"1": [0.0, 0.0, 0.0], "2": [0.0, 111.3195, 0.0]}, {"1": [1113.195, 0.0, 30.0]})
    lines = (json.dumps({"at_s": float(at_s), "places": place}) for at_s, place in enumerate(places))
    (run / "tracks.jsonl").write_text("".join(f"{line}\n" for line in lines))
    assert harness("chain", run, "--geojson", tmp_path / "map").returncode == 0
    (line,) = json.loads((tmp_path / "map").read_text())["features"]  # vehicle 2 has been in one place only
    (east, south, low), (still, north, high) = line["geometry"]["coordinates"]
    assert line["properties"] == {"agent": 1, "times": ["1970-01-01T00:00:00.000Z", "1970-01-01T00:00:01.000Z"]}
    assert (east, round(north - south, 6), high - low) == (still, 0.01, 30)
    assert harness("chain", run, "--agent", "2", "--kml", tmp_path / "kml").returncode == 0
    assert "vehicle 1" not in (tmp_path / "kml").read_text()
