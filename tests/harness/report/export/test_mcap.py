"""Test `ucp-harness export --mcap` by reading the file with the library of the format."""

import json
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from harness.archive.archive import RunArchive
from tests.harness.command import harness, sentences
from ucp.trace import HandlerRun

Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def messages(run: Path) -> Messages:
    file = run.parent / "run.mcap"
    exported = harness("export", run, "--mcap", file)
    assert exported.returncode == 0, exported.stderr
    assert exported.stderr == ""
    return read(file)


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run, tmp_path / "copy")


def read(file: Path) -> Messages:
    """Return the time and content of each message, by topic. The function checks JSON messages against their schema."""
    by_topic: Messages = defaultdict(list)
    validators: dict[str, Any] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if schema.encoding == "jsonschema":
                content: Any = json.loads(message.data)
                if schema.name not in validators:
                    strict = {**json.loads(schema.data), "additionalProperties": False}
                    jsonschema.Draft202012Validator.check_schema(strict)
                    validators[schema.name] = jsonschema.Draft202012Validator(strict)
                validators[schema.name].validate(content)
            else:
                assert schema.name.startswith("foxglove.")
                decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
                assert decode is not None
                content = decode(message.data)
            by_topic[channel.topic].append((message.log_time, content))
    return by_topic


def runs_of(run: Path, agent: int) -> list[HandlerRun]:
    return RunArchive(run).traces[agent].runs


def test_every_handler_run_is_exported_at_its_mission_second(run: Path, messages: Messages) -> None:
    for agent in (1, 2, 3):
        exported = messages[f"/agents/{agent}/handler_runs"]
        traced = runs_of(run, agent)
        assert [(at_ns, value["handler"], value["branch"]) for at_ns, value in exported] == [
            (round(step.t * 1e9), step.handler, step.branch) for step in traced
        ]


def test_chain_can_be_plotted(run: Path, messages: Messages) -> None:
    lengths = [value["chain"] for _, value in messages["/agents/1/state"]]
    assert lengths[-1] == len(RunArchive(run).exports.by_agent[1].chain) > 3
    assert messages["/agents/1/chain"][-1][1]["length"] == lengths[-1]
    assert messages["/agents/1/chain"][0][1]["block"].count(".") == 1
    assert messages["/swarm/replication"][-1][1]["longest_chain"] >= lengths[-1]


def test_message_lists_its_receivers(messages: Messages) -> None:
    values = [values for _, values in messages["/messages"]]
    assert any(message["received_by"] == [2, 3] and message["sender"] == 1 for message in values)
    assert any(message["receivers"] < 2 for message in values)


def test_vehicles_are_on_the_map_and_in_the_3d_view(run: Path, messages: Messages) -> None:
    assert {"/vehicles/1/location", "/vehicles/2/location", "/vehicles/3/location"} <= messages.keys()
    flown = RunArchive(run).tracks([1, 2, 3]).by_vehicle[1]
    at_ns, last = messages["/vehicles/1/location"][-1]
    assert at_ns == round(flown[-1].at_s * 1e9) == last.timestamp.ToNanoseconds()
    first = messages["/vehicles/1/location"][0][1]
    assert (last.latitude - first.latitude) * 111_319.5 == pytest.approx(flown[-1].north_m - flown[0].north_m, abs=0.01)
    (transform,) = [value for at, value in messages["/tf"] if at == at_ns and value.child_frame_id == "vehicle_1"]
    assert (transform.translation.x, transform.translation.y) == (flown[-1].east_m, flown[-1].north_m)
    drawn = [entity for _, update in messages["/scene"] for entity in update.entities]
    assert {"vehicle_1", "vehicle_2", "vehicle_3", "links"} == {entity.id for entity in drawn}


def test_link_has_the_loss_of_the_network_or_1_if_it_is_cut(messages: Messages) -> None:
    losses: dict[str, float] = {}
    at_75_s: dict[str, float] = {}
    for at_ns, value in messages["/network/losses"]:
        losses |= value
        at_75_s = dict(losses) if at_ns <= 75e9 else at_75_s
    assert at_75_s["loss_1_to_2"] == at_75_s["loss_3_to_1"] == 1.0
    assert at_75_s["loss_2_to_3"] == pytest.approx(0.1, abs=0.01)
    assert losses["loss_1_to_2"] < 1.0
    cut = next(value for at_ns, value in messages["/network/state"] if at_ns == 50e9)
    assert (cut["groups"], cut["connected"]) == (2, "2 3 | 1")
    links = {
        at_ns // 10**9: len(entity.lines[0].points)
        for at_ns, update in messages["/scene"]
        for entity in update.entities
        if entity.id == "links"
    }
    assert links[45] == 6  # three lines
    assert links[75] == 2


def test_telemetry_is_exported_and_values_that_are_no_number_are_left_out(messages: Messages) -> None:
    attitudes = messages["/vehicles/1/mavlink/ATTITUDE"]
    assert len(attitudes) == 30
    assert attitudes[7] == (
        7 * 10**9,
        {"mission_s": 7.0, "time_boot_ms": 7000, **dict.fromkeys(REST, 0.0), "roll": 0.25},
    )
    lines = [line for _, line in messages["/log"] if line.name == "vehicle 1"]
    assert [line.message for line in lines[:2]] == ["second 0", "second 1"]
    assert {line.level for line in lines} == {lines[0].ERROR}


REST = ("yaw", "rollspeed", "pitchspeed", "yawspeed")


def test_faults_and_verdicts_are_in_the_log(messages: Messages) -> None:
    lines = [(at_ns, line.name, line.message) for at_ns, line in messages["/log"]]
    assert (120 * 10**9, "faults", "reboot: agent 2, disk kept") in [
        (at_ns, name, text[:26]) for at_ns, name, text in lines
    ]
    assert len([text for _, name, text in lines if name == "verdicts"]) == 9


def test_log_has_operator_commands_and_unmatched_fates(copy: Path, tmp_path: Path) -> None:
    record = json.loads((copy / "run.json").read_text())
    command = {
        "at_s": 7.0,
        "until_s": 7.0,
        "vehicles": [1, 2],
        "message": "COMMAND_LONG",
        "command": "MAV_CMD_NAV_LAND",
    }
    record["ground_station"] = {"address": "127.0.0.1:14550", "commands": [command]}
    record["unmatched_fates"] = ["wind at 5 s: vehicle 3 cannot simulate it"]
    (copy / "run.json").write_text(json.dumps(record))
    assert harness("export", copy, "--mcap", tmp_path / "run.mcap").returncode == 0
    lines = [(at_ns, line.name, line.message) for at_ns, line in read(tmp_path / "run.mcap")["/log"]]
    assert (7 * 10**9, "operator", "MAV_CMD_NAV_LAND to vehicles 1 2") in lines
    assert "wind at 5 s: vehicle 3 cannot simulate it" in [text for _, name, text in lines if name == "faults"]


def test_damaged_run_is_exported_and_the_damage_is_reported(copy: Path, tmp_path: Path) -> None:
    tlog = copy / "vehicles" / "1" / "telemetry.tlog"
    data = tlog.read_bytes()
    tlog.write_bytes(data[:500] + b"\xfd\x00garbage\xfe" * 3 + data[500:])
    (copy / "agents" / "1.trace.jsonl").write_text("{}")
    with (copy / "agents" / "2.trace.jsonl").open("a") as trace:
        trace.write("no line of a trace\n")
    (copy / "run.json").write_text((copy / "run.json").read_text()[:900])
    (copy / "network.jsonl").unlink()
    (copy / "lab.log").write_bytes(b"1970-01-01 00:00:05,500 an \xff error\nmore of it\n")
    exported = harness("export", copy, "--mcap", tmp_path / "damaged.mcap")
    assert exported.returncode == 0
    said = " ".join(sentences(exported.stderr))
    for words in ("1.trace.jsonl", "2.trace.jsonl", "run.json", "network.jsonl is missing", "telemetry.tlog: damaged"):
        assert words in said
    messages = read(tmp_path / "damaged.mcap")
    assert 25 < len(messages["/vehicles/1/mavlink/ATTITUDE"]) <= 30
    assert "/agents/1/handler_runs" not in messages
    assert len(messages["/agents/3/handler_runs"]) == len(runs_of(copy, 3))
    lines = [(at_ns, line.name, line.message) for at_ns, line in messages["/log"]]
    assert (5_500_000_000, "lab.log", "an \ufffd error") in lines
    assert any(name == "export" and "1.trace.jsonl" in text for _, name, text in lines)


def test_flight_from_the_field_is_exported(run: Path, tmp_path: Path) -> None:
    imported = harness("import", *sorted((run / "agents").glob("*.json*")), "--out", tmp_path / "field")
    assert imported.returncode == 0, imported.stderr
    exported = harness("export", tmp_path / "field", "--mcap", tmp_path / "field.mcap")
    assert exported.returncode == 0, exported.stderr
    messages = read(tmp_path / "field.mcap")
    assert len(messages["/agents/3/handler_runs"]) == len(runs_of(run, 3))


def test_impossible_exports_are_refused_in_one_sentence(copy: Path, tmp_path: Path) -> None:
    there = tmp_path / "there.mcap"
    there.write_text("mine")
    (empty := tmp_path / "empty").mkdir()
    for arguments, words in (
        ((copy,), "no output is named: add --mcap FILE,"),
        ((copy, "--mcap", there), "exists: choose another file; existing files are not overwritten"),
        ((copy, "--mcap", tmp_path / "no" / "where.mcap"), "its directory does not exist"),
        ((empty, "--mcap", tmp_path / "new.mcap"), "neither a run directory nor"),
        ((tmp_path / "nothing", "--mcap", tmp_path / "new.mcap"), "is not a directory"),
    ):
        refused = harness("export", *arguments)
        (sentence,) = sentences(refused.stderr)
        assert (refused.returncode, words in sentence) == (2, True), sentence
    assert there.read_text() == "mine"
    assert not (tmp_path / "new.mcap").exists()
