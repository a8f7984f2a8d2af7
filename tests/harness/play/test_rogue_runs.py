"""Test whole runs with injected messages: the reactions of the agents, and the verdicts."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from scapy.layers.l2 import Ether
from scapy.packet import Packet
from scapy.utils import rdpcap

from harness.archive.record_file import validate_leniently
from harness.archive.run_record import InjectedMessages, RunRecord
from harness.errors import ScenarioError
from harness.play.process.process_preflight import add_rogue_listener
from harness.play.progress import SilentProgress
from harness.play.rogue.rogue_line import injection_of
from harness.report._fault_sections import rogue_section
from harness.run.run import Run, run
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.scenario.load import parse
from netem import addresses
from netem.conditions import LinkConditions, NetworkConditions
from tests.harness.command import Running, processes, sentences, write_scenario
from tests.harness.virtual import scenario
from ucp.scapy import UCP

FORGE = {"at_s": 200, "forge": {"message": "Commit Block", "sender": 2}}


def injecting(*timeline: dict[str, Any], **keys: Any) -> Scenario:
    chatty = {"duration_s": 300, "events": {"source": "random", "mean_s": 10}, "vehicles": {"kind": "none"}}
    return scenario(timeline=list(timeline), **{**chatty, **keys})


def played(tmp_path: Path, *timeline: dict[str, Any], **keys: Any) -> Run:
    return run(injecting(*timeline, **keys), 1, tmp_path / "run", SilentProgress(), "sim")


def violated(finished: Run) -> set[str]:
    return {number for number, one in finished.result.characteristics.items() if one.verdict == "violated"}


def only(finished: Run) -> InjectedMessages:
    """Return the record of the injected messages. The run has one injection, with messages of one type."""
    (injection,) = finished.rogue
    (messages,) = injection.messages
    return messages


def test_replayed_commits_are_handled_and_change_nothing(tmp_path: Path) -> None:
    finished = played(tmp_path, {"at_s": 200, "replay": {"message": "Commit Block", "count": 4}})
    again = only(finished)
    assert (again.sent, again.handled, again.changed) == (4, {"does not succeed": 16}, 0)
    assert not violated(finished)
    assert finished.exit_status == 0
    quiet = simulate(injecting(), 1)
    assert finished.result.figures["mutual_chain"] == quiet.result.figures["mutual_chain"]


def test_duplicates_change_nothing(tmp_path: Path) -> None:
    finished = played(
        tmp_path, {"at_s": 100, "duplicate": {"for_s": 100, "copies": 2, "message": "Block Add Response"}}
    )
    again = only(finished)
    assert again.sent > 20
    assert {"counted already", "no vote running"} & set(again.handled)
    assert sum(again.handled.values()) == 4 * again.sent
    assert again.unhandled == 0
    assert not violated(finished)


def test_delayed_commits_do_not_fit_the_grown_chain(tmp_path: Path) -> None:
    finished = played(tmp_path, {"at_s": 100, "delay": {"for_s": 100, "by_s": 40, "message": "Commit Block"}})
    late = only(finished)
    assert late.handled == {"does not succeed": 4 * late.sent}
    lines = [json.loads(line) for line in (tmp_path / "run" / "rogue.jsonl").read_text().splitlines()]
    assert {line["what"] for line in lines} == {"delay"}
    assert 140 <= min(line["at_s"] for line in lines) <= max(line["at_s"] for line in lines) <= 240
    assert not violated(finished)


def test_corrupt_messages_are_refused_or_change_no_chain(tmp_path: Path) -> None:
    finished = played(tmp_path, {"at_s": 100, "corrupt": {"for_s": 100, "bits": 2}})
    (injection,) = finished.rogue
    well_formed = sum(one.sent for one in injection.messages)
    malformed = sum(injection.refused.values())
    assert min(well_formed, malformed) > 10
    assert injection.sent == well_formed + malformed
    dropped = [agent.dropped or {} for agent in finished.played.agents.values()]
    for reason, count in injection.refused.items():
        assert sum(one.get(reason, 0) for one in dropped) == 4 * count
    assert violated(finished) <= {"1"}


def test_flood_is_noticed_by_characteristic_1_only(tmp_path: Path) -> None:
    finished = played(tmp_path, {"at_s": 100, "flood": {"for_s": 20, "per_s": 30, "message": "Chain Contain Query"}})
    flood = only(finished)
    assert (flood.sent, flood.changed, flood.unhandled) == (600, 0, 0)
    assert flood.handled == {"no": 2400}
    assert violated(finished) == {"1"}


def test_forged_votes_delay_the_commit_of_a_block(tmp_path: Path) -> None:
    no = {"message": "Block Add Response", "approve": False, "for_s": 60}
    votes = [{"at_s": 100 + agent, "forge": {**no, "sender": agent}} for agent in (1, 2, 3, 4, 5)]
    finished = played(tmp_path, *votes)
    assert all("no" in one.messages[0].handled for one in finished.rogue)
    assert (finished.result.figures["reconciles"] or 0) > 0
    assert simulate(injecting(), 1).result.figures["reconciles"] == 0
    assert violated(finished) == {"1"}


def check_forgery(finished: Run) -> None:
    """Check that all other agents commit the forged block, and that the check of characteristic 4 reports the block."""
    assert finished.exit_status == 1
    assert only(finished).handled == {"committed": 4}
    assert violated(finished) == {"1", "4"}
    for finding in finished.result.characteristics["4"].evidence:
        assert (finding.block or "").startswith("2.")
        assert f"holds block {finding.block}, which agent 2 never completed; the block arrived at t=2" in finding.detail


def test_forged_commit_is_found_and_reported(tmp_path: Path) -> None:
    finished = played(tmp_path, FORGE)
    check_forgery(finished)
    page = finished.report.read_text()
    assert '<h2 id="rogue">Rogue node</h2>' in page
    assert "<td>forge</td>" in page
    assert "committed 4" in page
    assert (
        "- forge at 200 s, Commit Block from 2: 1 sent; committed 4\n" in (finished.directory / "report.md").read_text()
    )
    (injection,) = json.loads((tmp_path / "run" / "run.json").read_text())["rogue"]
    assert (injection["at_s"], injection["detail"], injection["sent"]) == (200, "Commit Block from 2", 1)


def test_invalid_rogue_record_is_left_out_of_the_report() -> None:
    hostile = {"at_s": 1, "what": "<script>", "detail": "x", "refused": {"<b>": 2}}
    record, _ = validate_leniently(RunRecord, {"rogue": [hostile, {"at_s": "soon"}]})
    outcome = rogue_section(record.rogue)
    assert outcome is not None
    assert [(row.what, row.message, row.sent) for row in outcome.rows] == [("<script>", "none: <b>", "2")]
    assert rogue_section([]) is None


@pytest.mark.lab
def test_rogue_node_reaches_all_groups_and_is_no_vehicle(tmp_path: Path) -> None:
    apart = {"at_s": 190, "partition": [[1, 2], [3, 4, 5]]}
    chatty = {"duration_s": 260, "speedup": 20, "events": {"source": "random", "mean_s": 20}}
    replay = {"at_s": 180, "replay": {"message": "Commit Block"}}
    finished = run(injecting(replay, apart, FORGE, **chatty, capture=True), 1, tmp_path / "run", SilentProgress())
    assert finished.played.outcome == "completed", finished.played.outcome_detail
    replay_record, forge_record = finished.rogue
    assert (sum(replay_record.messages[0].handled.values()), replay_record.messages[0].changed) == (4, 0)
    assert set(forge_record.messages[0].handled) <= {"committed", "does not succeed", "reconcile in progress"}
    assert sum(forge_record.messages[0].handled.values()) == 4
    assert {"1", "4"} <= violated(finished)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    for counted in (record["agents"], record["counters"]["receivers"]):
        assert list(counted) == ["1", "2", "3", "4", "5"]
    assert record["roster"] == [1, 2, 3, 4, 5]
    captured = [rdpcap(str(tmp_path / "run" / "capture" / f"{agent}.pcapng")) for agent in record["roster"]]
    assert [len(list(filter(forged, packets))) for packets in captured] == [1] * 5
    assert {packet[Ether].src for packets in captured for packet in packets if forged(packet)} == {addresses.mac(2)}
    assert not (tmp_path / "run" / "capture" / "65535.pcapng").exists()
    assert record["counters"]["receivers"]["3"]["lost"] > 0
    assert [fault["what"] for fault in record["faults"]] == ["replay", "partition", "forge"]
    assert not (tmp_path / "run" / "rogue.control").exists()
    across = [
        step
        for agent, trace in finished_traces(tmp_path / "run").items()
        for step in trace
        if step["t"] > 200 and (agent in (1, 2)) != (step.get("trigger", {}).get("from", agent) in (1, 2))
    ]
    assert {step["trigger"]["seq"] >= 2**31 for step in across} == {True}


def finished_traces(directory: Path) -> dict[int, list[dict[str, Any]]]:
    return {
        agent: [json.loads(line) for line in (directory / "agents" / f"{agent}.trace.jsonl").read_text().splitlines()][
            1:
        ]
        for agent in (1, 2, 3, 4, 5)
    }


@pytest.mark.lab
@pytest.mark.any_user
def test_death_of_the_rogue_node_ends_the_run_as_a_harness_failure(tmp_path: Path) -> None:
    keys = {"duration_s": 2000, "speedup": 20, "vehicles": {"kind": "none"}, "timeline": [FORGE]}
    running = Running(write_scenario(tmp_path, **keys), tmp_path / "run", "--seed", 1)
    running.wait_for_mission(1)
    (pid,) = [pid for pid, command in processes(tmp_path / "run").items() if "harness.play.rogue" in command]
    os.kill(pid, signal.SIGKILL)
    status, _, err = running.end()
    assert status == 3
    assert sentences(err)[0].startswith("the rogue node ended by itself with SIGKILL; its log is rogue.log; the chains")
    assert not processes(tmp_path / "run")


def test_captures_of_receivers_contain_rogue_datagrams(tmp_path: Path) -> None:
    played(tmp_path, FORGE, capture=True)
    folder = tmp_path / "run" / "capture"
    assert sorted(path.name for path in folder.iterdir()) == [f"{agent}.pcapng" for agent in (1, 2, 3, 4, 5)]
    assert [len([one for one in rdpcap(str(folder / f"{agent}.pcapng")) if forged(one)]) for agent in (1, 2)] == [1, 0]


def forged(packet: Packet) -> bool:
    return UCP in packet and injection_of(packet[UCP].sequence) is not None


def test_injection_without_effect_is_reported(tmp_path: Path) -> None:
    finished = played(tmp_path, {"at_s": 0.5, "replay": {"message": "Block Response", "sender": 4}})
    (sentence,) = finished.played.unmatched_fates
    assert sentence.startswith("replay at 0.5 s (the last 1 of Block Response from 4) sent nothing")
    assert finished.exit_status == 2


def test_harmless_injection_leaves_the_run_of_a_seed_unchanged() -> None:
    one = injecting({"at_s": 100, "flood": {"for_s": 20, "per_s": 10}}, FORGE)
    again = [simulate(one, 1, tracing=True).evidence for _ in range(2)]
    assert again[0].exports == again[1].exports
    assert again[0].traces == again[1].traces


def test_dead_and_paused_agents_receive_rogue_datagrams_as_usual(tmp_path: Path) -> None:
    gone = [{"at_s": 190, "kill": [3]}, {"at_s": 191, "pause": [4]}, {"at_s": 220, "resume": [4]}]
    finished = played(tmp_path, *gone, FORGE)
    assert sum(only(finished).handled.values()) == 3
    assert "4" in violated(finished)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"replay": {"count": 0}}, "`timeline.0.replay.count` is 0: it should be greater than or equal to 1"),
        (
            {"replay": {"message": "Commit"}},
            "`timeline.0.replay.message` is 'Commit': it should be 'Block Add Request'",
        ),
        (
            {"replay": {"sender": 9}},
            "timeline.0.replay.sender names vehicle 9, which is not on the roster: use one of 1, 2",
        ),
        ({"replay": {}, "heal": True}, "needs exactly one of `loss`"),
        ({"duplicate": {}}, "`timeline.0.duplicate.for_s` is missing"),
        (
            {"delay": {"for_s": 100, "by_s": 200}},
            "timeline.0.delay would last until 400 s, after the mission's end at 300",
        ),
        ({"corrupt": {"for_s": 5, "bits": 0}}, "`timeline.0.corrupt.bits` is 0: it should be greater than or equal"),
        ({"forge": {"message": "Commit Block"}}, "`timeline.0.forge.sender` is missing"),
        ({"forge": {"message": "Request for Block", "sender": 1}}, "it should be 'Commit Block', 'Block Add Response'"),
        (
            {"forge": {"message": "Block Add Response", "sender": 1}},
            "forged answers (Block Add Response",
        ),
        ({"forge": {"message": "Commit Block", "sender": 1, "approve": True}}, "a Commit Block has no vote"),
        ({"flood": {"for_s": 100, "per_s": 5000}}, "500000 messages are too many: a flood has at most 100000"),
        ({"lie": {"message": "Commit Block", "sender": 1, "block": "1.1"}}, "a Commit Block needs `block` and `chain`"),
        ({"lie": {"message": "Request for Block", "sender": 1, "block": 2.1}}, "`timeline.0.lie.block` is 2.1"),
        (
            {"lie": {"message": "Chain Contain Query", "sender": 1, "chain": [], "receivers": [9]}},
            "timeline.0.lie.receivers names vehicle 9, which is not on the roster",
        ),
    ],
)
def test_mistake_in_an_injection_causes_one_sentence(entry: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ScenarioError) as error:
        parse({"name": "x", "agents": 5, "duration_s": 300, "timeline": [{"at_s": 100, **entry}]})
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_rogue_links_are_perfect_and_other_links_unchanged() -> None:
    asked = NetworkConditions(LinkConditions(loss=0.2), receivers={3: LinkConditions(loss=0.5)})
    asked = asked.with_partition([[1, 2], [3]])
    held = add_rogue_listener(asked, injecting(FORGE, agents=3))
    rogue = injecting(FORGE, agents=3).rogue
    assert rogue == 65535
    assert injecting(FORGE, agents=[65535, 2]).rogue == 65534
    assert not held.partition
    for one in (1, 2, 3):
        assert held.link(one, rogue).lossless
        assert held.link(rogue, one).lossless
    for sender, receiver in ((1, 2), (2, 1), (1, 3), (3, 1), (2, 3), (3, 2)):
        lost = 1.0 if asked.is_cut(sender, receiver) else asked.link(sender, receiver).loss
        assert held.link(sender, receiver).loss == lost
    assert add_rogue_listener(asked, injecting(agents=3)) is asked
