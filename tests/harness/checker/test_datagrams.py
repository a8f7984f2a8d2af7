"""Test that the kernel's counters reveal agents that discard datagrams without recording them, and agents that stop
reading datagrams.

Test that the checker compares the log of a shared channel with the traces and run.json.
"""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.checker import Result, check, gather
from harness.checker.records import _channel_vs_traces
from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.command import harness
from tests.harness.mission import edit
from tests.harness.virtual import scenario

DISCARDS_EVERY_TENTH = """
import sys
from functools import partial
from ucp import node

class Silent(node.Node):
    read = 0

    def _feed(self, feed):
        if isinstance(feed, partial) and feed.func == self.agent.receive_datagram:
            self.read += 1
            if self.read % 10 == 0:
                return
        super()._feed(feed)

sys.exit(node.main(sys.argv[1:], Silent))
"""

STOPS_READING = """
import sys
from ucp import node

class Deaf(node.Node):
    def _receive(self):
        super()._receive()
        if self.clock.now() > 20:
            self._loop.watch(self._socket)

sys.exit(node.main(sys.argv[1:], Deaf))
"""

OFTEN = {"source": "random", "mean_s": 2}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run of three agents in virtual time. One agent is killed and restarted."""
    asked = scenario(
        agents=3,
        duration_s=120,
        events=OFTEN,
        timeline=[{"at_s": 60, "kill": [3]}, {"at_s": 80, "restart": [3]}],
    )
    return run(
        asked, 1, tmp_path_factory.mktemp("whole") / "run", SilentProgress(), backend="sim", delivers_all=True
    ).directory


def judged(directory: Path, tmp_path: Path, agent: int, more: int, unread: int = 0, others: int = 0) -> Result:
    """Judge the run after counters of the kernel were added to it. According to these counters, the agent read the
    datagrams that it recorded, and `more` others.
    """
    shutil.copytree(directory, tmp_path / "run")
    lines = [json.loads(line) for line in (directory / f"agents/{agent}.trace.jsonl").read_text().splitlines()]
    received = sum("message" in line.get("trigger", {}) for line in lines)
    sent = sum(len(line.get("sent", ())) for line in lines)
    read = received + sent + more + 2
    counters = {"before_start": 2, "read": read, "overflowed": 3, "unreachable": 5, "broadcasts": read + 8 + unread}
    counted = {str(agent): {**counters, "others": others}}
    edit(tmp_path / "run" / "run.json", lambda record: record.update(datagrams=counted))
    return check(gather(RunArchive(tmp_path / "run")))


@pytest.mark.lab
def test_agent_that_discards_every_tenth_datagram_is_found(tmp_path: Path) -> None:
    program = tmp_path / "agent.py"
    program.write_text(DISCARDS_EVERY_TENTH)
    asked = scenario(
        agents=4,
        duration_s=60,
        speedup=20,
        vehicles={"kind": "none"},
        events=OFTEN,
        agent_command={2: [sys.executable, str(program)]},
        timeline=[
            {"at_s": 15, "pause": [1]},
            {"at_s": 25, "resume": [1]},
            {"at_s": 30, "reboot": [3], "down_s": 10, "disk": "kept"},
            {"at_s": 31, "kill": [4]},
            {"at_s": 40, "restart": [4]},
        ],
    )
    found = run(asked, 1, tmp_path / "run", SilentProgress(), backend="process").result
    records = found.beside["records"]
    assert records.verdict == "contradict"
    assert {finding.agent_id for finding in records.evidence} == {2}
    assert "datagrams that its trace lacks" in records.evidence[0].detail
    assert found.beside["steps"].verdict == "not applicable"


def test_datagrams_of_other_sockets_do_not_count(whole: Path, tmp_path: Path) -> None:
    assert judged(whole, tmp_path, 1, more=20, others=20).beside["records"].verdict == "agree"


@pytest.mark.parametrize(("more", "agrees"), [(-5, True), (0, True), (20, False)])
def test_datagram_that_was_read_needs_a_line_in_the_trace(whole: Path, tmp_path: Path, more: int, agrees: bool) -> None:
    found = judged(whole, tmp_path, 1, more).beside["records"]
    assert (found.verdict == "agree") == agrees, found
    assert agrees or "it read 20 datagrams that its trace lacks" in found.evidence[0].detail


@pytest.mark.lab
@pytest.mark.any_user
def test_agent_that_stops_reading_is_found(tmp_path: Path) -> None:
    program = tmp_path / "agent.py"
    program.write_text(STOPS_READING)
    asked = scenario(
        agents=3,
        duration_s=120,
        speedup=20,
        vehicles={"kind": "none"},
        events=OFTEN,
        agent_command={2: [sys.executable, str(program)]},
        timeline=[{"at_s": 30, "kill": [3]}, {"at_s": 50, "restart": [3]}],
    )
    records = run(asked, 1, tmp_path / "run", SilentProgress(), backend="process").result.beside["records"]
    assert records.verdict == "contradict"
    assert {finding.agent_id for finding in records.evidence} == {2}
    assert "were left unread in its socket" in records.evidence[0].detail


def test_datagram_that_arrived_needs_a_reader(whole: Path, tmp_path: Path) -> None:
    found = judged(whole, tmp_path, 1, 0, unread=60).beside["records"]
    assert "60 of" in found.evidence[0].detail
    assert "datagrams that arrived were left unread in its socket" in found.evidence[0].detail


def test_datagram_of_a_paused_agent_may_stay_unread(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "paused")
    pause = {"at_s": 100.0, "what": "pause", "detail": "agent 1", "agents": [1]}
    edit(tmp_path / "paused" / "run.json", lambda record: record["faults"].append(pause))
    details = [finding.detail for finding in judged(tmp_path / "paused", tmp_path, 1, 0, 60).beside["records"].evidence]
    assert not any("unread" in detail for detail in details)


def test_datagram_in_transit_at_a_kill_may_lack_its_line(whole: Path, tmp_path: Path) -> None:
    assert judged(whole, tmp_path, 3, 1).beside["records"].verdict == "agree"


def test_revocation_without_a_line_is_no_contradiction(whole: Path, tmp_path: Path) -> None:
    copy: Any = tmp_path / "revoked"
    shutil.copytree(whole, copy)
    with (copy / "agents/2.trace.jsonl").open("a") as trace:
        trace.write('{"t":500,"command":"revoke","request":{}}\n')
    assert judged(copy, tmp_path, 1, 20).beside["records"].verdict == "agree"


CROWD = """
name: Crowd
agents: 6
duration_s: 120
final_reconcile: true
network: {loss: 0.1, channel: {preset: wifi_1, processing_s: 0}}
"""
Lines = list[dict[str, Any]]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("channel")
    (folder / "crowd.yaml").write_text(CROWD)
    done = harness("run", folder / "crowd.yaml", "--backend", "sim", "--seed", 1, "--out", folder / "run")
    assert (folder / "run" / "run.json").exists(), done.stderr
    return folder / "run"


def details(run: Path, edit: Callable[[Lines], Lines] | None = None) -> list[str]:
    """Return the findings of the check of records after the channel's log is edited."""
    journal = run / "channel.jsonl"
    original = journal.read_text()
    if edit is not None:
        lines = edit([json.loads(line) for line in original.splitlines()])
        journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    try:
        evidence = checker.gather(RunArchive(run))
        return [contradiction.finding.detail for contradiction in _channel_vs_traces.compare(evidence)]
    finally:
        journal.write_text(original)


def test_journal_of_a_run_agrees_with_its_traces(played: Path) -> None:
    assert details(played) == []


def test_handled_message_that_the_channel_lost_contradicts(played: Path) -> None:
    def lose_all(lines: Lines) -> Lines:
        return [{**line, "lost": {"fade": [1]}} if line["sender"] == 2 else line for line in lines]

    found = details(played, lose_all)
    assert any("it handled a message that the channel had lost" in detail for detail in found)
    assert any("different numbers of frames or losses" in detail for detail in found)


def test_handled_message_that_the_channel_never_carried_contradicts(played: Path) -> None:
    found = details(played, lambda lines: lines[: len(lines) // 2])
    assert any("it handled a message that the channel never carried" in detail for detail in found)


def test_count_of_run_json_contradicts_a_shorter_journal(played: Path) -> None:
    assert "different numbers of frames or losses" in details(played, lambda lines: lines[:-1])[0]
