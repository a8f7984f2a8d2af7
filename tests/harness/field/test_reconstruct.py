"""Test the reconstruction of flights from the records of runs in virtual time.

Test that `reconstruct` reproduces any flight of correct agents with complete records to the last block.
"""

import base64
import json
import shutil
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.errors import FieldError
from harness.field.ingest import ingest_files
from harness.field.reconstruct import Reconstruction, reconstruct, write
from harness.run.simulate import simulate
from harness.scenario import load_scenario
from tests.harness.command import harness, sentences
from tests.harness.field.flights import flown, trace_of
from tests.harness.proof.edited_core import Bug, edited, with_core
from ucp.messages import BlockAddResponse, decode, encode
from ucp.trace import in_base64

FIELD: dict[str, Any] = {
    "agents": [10, 28, 32, 118, 120],
    "duration_s": 600,
    "network": {"loss": 0.15},
    "events": {"source": "random", "mean_s": 10},
    "clocks": {28: {"offset_s": 3.2, "drift": 0.0001}, 118: {"offset_s": -2, "drift": -0.002}},
    "timeline": [
        {"at_s": 100, "partition": [[10, 28], [32, 118, 120]]},
        {"at_s": 200, "heal": True},
        {"at_s": 250, "pause": [10]},
        {"at_s": 290, "resume": [10]},
        {"at_s": 300, "kill": [32]},
        {"at_s": 350, "restart": [32]},
        {"at_s": 400, "reboot": [120], "down_s": 20, "disk": "kept"},
        {"at_s": 550, "reconcile": [28]},
    ],
}


def field_records(directory: Path, run: Path, *left_out: str) -> Path:
    """Copy those records of a run that also exist after a real flight."""
    directory.mkdir()
    for path in (run / "agents").glob("*.json*"):
        if path.name not in left_out:
            shutil.copy(path, directory)
    return directory


def reconstruct_from(directory: Path) -> Reconstruction:
    return reconstruct(ingest_files([directory]).largest(), "again")


def test_flight_with_typical_faults_is_reproduced(tmp_path: Path) -> None:
    reconstruction = reconstruct_from(field_records(tmp_path / "home", flown(tmp_path / "run", **FIELD)))
    assert reconstruction.problems == []
    assert reconstruction.reproduced == FIELD["agents"]
    faults = [key for entry in reconstruction.document["timeline"] for key in entry if key != "at_s"]
    assert [fault for fault in faults if fault in ("pause", "resume", "kill", "restart", "reboot", "reconcile")] == [
        *("pause", "resume", "kill", "restart", "reboot", "reconcile")
    ]


def test_flight_whose_answers_waited_is_reproduced(tmp_path: Path) -> None:
    spread = {"settings": {"answer_spread_s": 0.5}}
    reconstruction = reconstruct_from(field_records(tmp_path / "home", flown(tmp_path / "run", **FIELD, **spread)))
    assert reconstruction.problems == []
    assert reconstruction.reproduced == FIELD["agents"]


def test_written_scenario_meets_its_expectations(tmp_path: Path) -> None:
    reconstruction = reconstruct_from(field_records(tmp_path / "home", flown(tmp_path / "run", **FIELD)))
    write(reconstruction, tmp_path / "again.yaml", [tmp_path / "home"], [])
    scenario = load_scenario(tmp_path / "again.yaml")
    simulated = simulate(scenario, 77, tracing=True)
    assert scenario.expect is not None
    assert simulated.played.unmatched_fates == []
    tops = {agent: export.top_chain_hash for agent, export in simulated.evidence.exports.items()}
    assert [*scenario.expect.unexpected_chains(tops)] == []
    assert all(scenario.expect.as_expected(key, of.verdict) for key, of in simulated.result.judgements.items())


def test_agent_without_export_is_lost_at_end_of_trace(tmp_path: Path) -> None:
    run = flown(tmp_path / "run", events={"source": "random", "mean_s": 8}, timeline=[{"at_s": 200, "kill": [3]}])
    reconstruction = reconstruct_from(field_records(tmp_path / "home", run))
    assert reconstruction.reproduced == [1, 2, 3]
    (off,) = [entry for entry in reconstruction.document["timeline"] if entry.get("switch_off") == [3]]
    assert off["at_s"] < 200


def test_clock_offsets_and_drifts_are_estimated(tmp_path: Path) -> None:
    clocks = reconstruct_from(field_records(tmp_path / "home", flown(tmp_path / "run", **FIELD))).table.clocks
    beside = clocks[28].after(clocks[10].inverse())
    assert beside.shows(300.0) - 300.0 == pytest.approx(3.2 + 0.0001 * 300, abs=0.05)


def test_messages_of_an_unrecorded_agent_are_sent_separately(tmp_path: Path) -> None:
    run = flown(tmp_path / "run", **FIELD)
    reconstruction = reconstruct_from(field_records(tmp_path / "home", run, "118.trace.jsonl", "118.chain.json"))
    assert reconstruction.problems == []
    assert reconstruction.reproduced == [10, 28, 32, 120]
    assert {datagram["source"] for datagram in reconstruction.document["datagrams"]} == {118}
    assert any("agent 118 not played" in remark for remark in reconstruction.remarks)


def test_inputs_after_a_truncated_trace_are_inferred_from_the_export(tmp_path: Path) -> None:
    directory = field_records(tmp_path / "home", flown(tmp_path / "run", **FIELD))
    trace = directory / "118.trace.jsonl"
    lines = trace.read_bytes().splitlines(keepends=True)
    trace.write_bytes(b"".join(lines[: len(lines) // 2]))
    reconstruction = reconstruct_from(directory)
    assert reconstruction.problems == []
    assert any("inputs of agent 118 are inferred" in remark for remark in reconstruction.remarks)


def test_wrong_agent_is_explained_by_a_quirk_or_its_first_deviation(tmp_path: Path) -> None:
    wrong = {"approve_everything": {"agents": [2]}}
    named = reconstruct_from(
        field_records(tmp_path / "home", flown(tmp_path / "run", network={"loss": 0.3}, quirks=wrong))
    )
    assert named.problems == []
    assert any("agent 2 behaves as with approve_everything" in remark for remark in named.remarks)
    ignoring = {"ignore_commit": {"agents": [2], "value": 0.5}}
    parted = reconstruct_from(field_records(tmp_path / "home2", flown(tmp_path / "run2", quirks=ignoring)))
    assert parted.problems == []
    assert any("agent 2 did not react to" in remark and "receive_commit_block" in remark for remark in parted.remarks)


def test_edited_core_is_named_if_a_correct_record_does_not_play(tmp_path: Path) -> None:
    home = field_records(tmp_path / "home", flown(tmp_path / "run", agents=3, duration_s=100))
    right = "approve = message.chain_hash == core.chain.top_chain_hash"
    core = edited(tmp_path, Bug("commit.py", right, right.replace("==", "!=")))
    done = with_core(core, "reconstruct", home, "-o", "again.yaml", cwd=tmp_path)
    assert "its record follows the protocol there, but the agent core was edited (ucp/commit.py)" in done.stdout
    assert "deviates from the protocol" not in done.stdout


def test_unknown_deviation_ends_the_play_of_its_agent(tmp_path: Path) -> None:
    directory = field_records(tmp_path / "home", flown(tmp_path / "run", events={"source": "random", "mean_s": 5}))
    trace = directory / "2.trace.jsonl"
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    number = next(n for n, line in enumerate(lines) if n > 20 and line.get("branch") == "approve")
    sent = lines[number]["sent"][0]
    datagram = decode(base64.b64decode(sent["datagram"]))
    assert isinstance(datagram.message, BlockAddResponse)
    vote = encode(2, sent["seq"], replace(datagram.message, approve=False))
    lines[number]["branch"], sent["datagram"] = "disapprove", base64.b64encode(vote).decode()
    trace.write_text("".join(json.dumps(line) + "\n" for line in lines))
    reconstruction = reconstruct_from(directory)
    assert reconstruction.reproduced == [1, 3]
    assert "agent 2 deviates from the protocol, and is played up to trace line" in reconstruction.problems[0]
    assert "receive_request_add_block" in reconstruction.problems[0]
    assert {datagram["source"] for datagram in reconstruction.document["datagrams"]} == {2}


def test_record_without_optional_parts_is_reproduced(tmp_path: Path) -> None:
    directory = field_records(tmp_path / "home", flown(tmp_path / "run", agents=3))
    for path in directory.glob("*.trace.jsonl"):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            line.pop("tally", None)
            line.pop("started", None)
            if "t" in line:
                line["t"] = round(line["t"], 3)
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert reconstruct_from(directory).problems == []


def test_records_without_inputs_are_rejected(tmp_path: Path) -> None:
    directory = field_records(
        tmp_path / "home", flown(tmp_path / "run"), *(f"{agent}.trace.jsonl" for agent in (1, 2, 3))
    )
    with pytest.raises(FieldError, match="add traces"):
        reconstruct_from(directory)


def test_command_prints_the_reproduced_part(tmp_path: Path) -> None:
    run = flown(tmp_path / "run")
    out = tmp_path / "again.yaml"
    made = harness("reconstruct", run, "-o", out, "--json")
    assert made.returncode == 0, made.stderr
    assert json.loads(made.stdout)["reproduced"] is True
    assert out.read_text().startswith("# Made by `ucp-harness reconstruct`")
    refused = harness("reconstruct", run, "-o", out)
    assert refused.returncode == 2
    assert sentences(refused.stderr) == [f"{out} exists: choose another --out; existing files are not overwritten"]
    trace = trace_of(run, 2)
    trace.write_bytes(trace.read_bytes()[:20_000])
    cut = harness("reconstruct", run, "-o", tmp_path / "cut.yaml")
    assert cut.returncode == 0
    assert "inputs of agent 2 are inferred" in cut.stdout
    (run / "agents" / "2.chain.json").unlink()
    trace.unlink()
    gone = harness("reconstruct", run, "-o", tmp_path / "gone.yaml")
    assert gone.returncode == 0
    assert "agent 2 not played" in gone.stdout


def test_exports_and_captures_suffice_without_traces(tmp_path: Path) -> None:
    run = flown(tmp_path / "run", network={"loss": 0.2}, capture=True, final_reconcile=True)
    directory = field_records(tmp_path / "home", run, *(f"{agent}.trace.jsonl" for agent in (1, 2, 3)))
    for path in (run / "capture").glob("*.pcapng"):
        shutil.copy(path, directory)
    reconstruction = reconstruct_from(directory)
    assert reconstruction.problems == []
    assert reconstruction.reproduced == [1, 2, 3]
    assert any("captures and blocks" in remark for remark in reconstruction.remarks)


def test_missing_inputs_of_version_1_come_from_other_records(tmp_path: Path) -> None:
    directory = field_records(tmp_path / "home", flown(tmp_path / "run", network={"loss": 0.2}))
    trace = directory / "2.trace.jsonl"
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    lines[0]["schema"] = "ucp-trace/1"
    for line in lines:
        for key in ("initial_data", "input", "tally", "started"):
            line.pop(key, None)
        for sent in line.get("sent", ()):
            del sent["datagram"]
    trace.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert reconstruct_from(directory).problems == []


def test_unrecorded_settings_and_incarnations_are_inferred(tmp_path: Path) -> None:
    flight = {"capture": True, "events": {"source": "random", "mean_s": 8}, "settings": {"vote_names_chain": True}}
    reboot = [{"at_s": 150, "reboot": [2], "down_s": 20, "disk": "kept"}]
    run = flown(tmp_path / "run", network={"loss": 0.1}, timeline=reboot, **flight)
    directory = field_records(tmp_path / "home", run, *(f"{agent}.trace.jsonl" for agent in (1, 2, 3)))
    for path in (run / "capture").glob("*.pcapng"):
        shutil.copy(path, directory)
    reconstruction = reconstruct_from(directory)
    assert reconstruction.problems == []
    assert any("vote_names_chain True" in remark for remark in reconstruction.remarks)
    assert any("reboot" in entry for entry in reconstruction.document["timeline"])


def test_sequence_numbers_of_an_agent_do_not_matter(tmp_path: Path) -> None:
    directory = field_records(tmp_path / "home", flown(tmp_path / "run", network={"loss": 0.2}))

    def recounted(text: str) -> str:
        sender, sequence, message = decode(base64.b64decode(text))
        return in_base64(encode(sender, sequence + 5 * (sender == 2), message))

    for path in directory.glob("*.trace.jsonl"):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines[1:]:
            if line["trigger"].get("from") == 2:
                line["trigger"]["seq"] += 5
            if "from" in line["trigger"]:
                line["input"] = recounted(line["input"])
            for sent in line["sent"]:
                sent["seq"] += 5 * path.name.startswith("2.")
                sent["datagram"] = recounted(sent["datagram"])
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    reconstruction = reconstruct_from(directory)
    assert reconstruction.problems == []
    assert "datagrams" not in reconstruction.document


AGENTS = (1, 2, 3, 4)
DURATION_S = 300


@st.composite
def flights(draw: st.DrawFn) -> dict[str, Any]:
    """Draw a random flight with loss, a partition, a kill or a pause, and inaccurate clocks."""
    struck, at_s = draw(st.sampled_from(AGENTS)), draw(st.integers(60, 120))
    back_s = at_s + draw(st.integers(5, 100))
    death = draw(
        st.sampled_from(
            [
                [],
                [{"at_s": at_s, "kill": [struck]}],
                [{"at_s": at_s, "kill": [struck]}, {"at_s": back_s, "restart": [struck]}],
                [{"at_s": at_s, "reboot": [struck], "down_s": 10, "disk": "kept"}],
                [{"at_s": at_s, "pause": [struck]}, {"at_s": back_s, "resume": [struck]}],
                [{"at_s": at_s, "switch_off": [struck]}],
            ]
        )
    )
    apart = draw(st.sets(st.sampled_from(AGENTS), max_size=3))
    partition = [{"at_s": 30.5, "partition": [sorted(apart)], "for_s": 100}] if apart else []
    clock = st.fixed_dictionaries(
        {"offset_s": st.floats(0, 100), "drift": st.floats(-0.01, 0.01)},
    )
    return {
        "agents": list(AGENTS),
        "duration_s": DURATION_S,
        "network": {"loss": draw(st.sampled_from([0.0, 0.1, 0.4]))},
        "events": {"source": "random", "mean_s": draw(st.sampled_from([3.0, 10.0]))},
        "clocks": draw(st.dictionaries(st.sampled_from(AGENTS), clock)),
        "timeline": [*partition, *death],
        "final_reconcile": draw(st.booleans()),
    }


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(flight=flights(), seed=st.integers(0, 1000))
def test_complete_record_is_reproduced(flight: dict[str, Any], seed: int) -> None:
    with TemporaryDirectory() as kept:
        run = flown(Path(kept) / "run", seed, **flight)
        made = reconstruct(ingest_files([run / "agents"]).largest(), "again")
    assert made.problems == []
    assert made.table.contradictions == []
