"""Test that the check finds records that contradict the scenario, the faults, the network or the end of the run.

Test that the checker compares lost messages with the loss rate, for runs in memory and for networks that duplicate
packets.
"""

import base64
import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.archive.traces import Trace
from harness.checker import Evidence, check, gather
from harness.checker.records import _losses
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import simulate
from tests.harness.mission import edit, edit_lines
from tests.harness.virtual import scenario
from ucp.trigger import MessageTrigger

Document = dict[str, Any]
Edit = Callable[[Path], None]


@pytest.fixture(scope="module")
def unaltered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run with a reboot, a partition, a kill, a restart, a pause and a final reconcile."""
    asked = scenario(
        agents=4,
        duration_s=400,
        network={"loss": 0.2},
        events={"source": "random", "mean_s": 6},
        timeline=[
            {"at_s": 60, "reboot": [2], "down_s": 20, "disk": "kept"},
            {"at_s": 100, "partition": [[1, 2]], "for_s": 60},
            {"at_s": 200, "kill": [3]},
            {"at_s": 240, "restart": [3]},
            {"at_s": 260, "pause": [4]},
            {"at_s": 300, "resume": [4]},
        ],
        final_reconcile=True,
    )
    return run(asked, 3, tmp_path_factory.mktemp("unaltered") / "run", SilentProgress(), backend="sim").directory


@pytest.fixture
def directory(unaltered: Path, tmp_path: Path) -> Path:
    shutil.copytree(unaltered, tmp_path / "run")
    return tmp_path / "run"


def found(directory: Path) -> str:
    """Return the findings of the check of the records."""
    judgement = check(gather(RunArchive(directory))).beside["records"]
    assert judgement.verdict == "contradict"
    return "\n".join(finding.detail for finding in judgement.evidence)


def edit_scenario(change: Callable[[Document], Any]) -> Edit:
    return lambda directory: edit(directory / "run.json", lambda record: change(record["scenario"]))


def without_change(what: str) -> Edit:
    """Remove a recorded change from run.json and from network.jsonl."""

    def remove(directory: Path) -> None:
        edit(
            directory / "run.json",
            lambda record: record.update(
                {key: [each for each in record[key] if each["what"] != what] for key in ("faults", "network")}
            ),
        )
        edit_lines(
            directory / "network.jsonl",
            lambda lines: lines.__setitem__(slice(None), [line for line in lines if line["what"] != what]),
        )

    return remove


def with_loss(loss: float) -> Edit:
    """Change the loss rate in the same way in the scenario, run.json and network.jsonl."""

    def change(entry: Document) -> None:
        entry["detail"] = entry["detail"].replace("loss 20 %", f"loss {loss * 100:g} %")
        if entry.get("asked", {}).get("default", {}).get("loss") == 0.2:
            entry["asked"]["default"]["loss"] = loss

    def replace(directory: Path) -> None:
        def of_record(record: Document) -> None:
            record["scenario"]["network"]["loss"] = loss
            for entry in record["network"] + record["faults"]:
                change(entry)

        edit(directory / "run.json", of_record)
        edit_lines(directory / "network.jsonl", lambda lines: [change(line) for line in lines])

    return replace


def with_message_at(agent_id: int, at_s: float) -> Edit:
    """Change the time of the last message that the agent handled before `at_s` to `at_s`."""

    def move(lines: list[Document]) -> None:
        before = [line for line in lines if line.get("handler", "").startswith("receive_") and line["t"] < at_s]
        before[-1]["t"] = at_s

    return lambda directory: edit_lines(directory / "agents" / f"{agent_id}.trace.jsonl", move)


def exported_later(by_s: float) -> Edit:
    return lambda directory: edit(
        directory / "agents" / "1.chain.json",
        lambda export: export.update(exported_at_us=export["exported_at_us"] + round(by_s * 1e6)),
    )


def test_unaltered_run_agrees(unaltered: Path) -> None:
    result = check(gather(RunArchive(unaltered)))
    assert result.beside["records"].verdict == "agree"
    assert not result.bad


@pytest.mark.parametrize(
    ("altered", "expected"),
    [
        (without_change("kill"), "the scenario has kill at 200 s, agent 3, but run.json lacks it"),
        (without_change("pause"), "the scenario has pause at 260 s, agent 4, but run.json lacks it"),
        (without_change("partition"), "the scenario has partition at 100 s"),
        (edit_scenario(lambda asked: asked["network"].update(loss=0.3)), "loss 30 %, but run.json lacks it"),
        (edit_scenario(lambda asked: asked.update(agents=5)), "the roster of run.json differ in agent 5"),
        (edit_scenario(lambda asked: asked["timeline"][4].update(at_s=261)), "run.json has this change at 260 s"),
        (edit_scenario(lambda asked: asked["timeline"][1].update(partition=[[1, 3]])), "partition 1 3, but run.json"),
        (edit_scenario(lambda asked: asked.update(duration_s=9000)), "but its scenario lasts 9000 s"),
        (edit_scenario(lambda asked: asked.update(final_reconcile=False)), "but its scenario asks for none"),
        (edit_scenario(lambda asked: asked["settings"].update(vote_timeout_s=15)), "its trace has vote_timeout_s 10"),
        (lambda run: edit(run / "run.json", lambda record: record.update(mission_s=9000)), "ended for it at 9000 s"),
        (lambda run: edit(run / "run.json", lambda record: record.update(mission_s=390)), "its scenario lasts 400 s"),
        (exported_later(100), "its export is of"),
        (exported_later(-100), "its export is of"),
        (with_message_at(3, 230.0), "although its kill at 200 s had stopped the agent"),
        (with_message_at(2, 75.0), "although its reboot at 60 s had stopped the agent"),
        (with_message_at(4, 290.0), "although its pause at 260 s had stopped the agent"),
        (with_loss(0.6), "of them are lost"),
        (with_loss(0.05), "of them are lost"),
        (with_loss(0.0), "of them are lost"),
    ],
)
def test_altered_record_contradicts_others(directory: Path, altered: Edit, expected: str) -> None:
    altered(directory)
    assert expected in found(directory)


def test_message_over_partition_is_found(directory: Path) -> None:
    """Change the sender of a message that agent 1 handled during the partition. The new sender is on the other side."""

    def swap(lines: list[Document]) -> None:
        theirs = {line["t"]: sent for line in lines for sent in line.get("sent", ()) if 105 < line["t"] < 150}
        assert theirs
        at_s, sent = next(iter(theirs.items()))
        heard.update(at_s=at_s, sent=sent)

    heard: Document = {}
    edit_lines(directory / "agents" / "3.trace.jsonl", swap)

    def take(lines: list[Document]) -> None:
        line = next(
            line for line in lines if line.get("handler", "").startswith("receive_") and line["t"] > heard["at_s"]
        )
        line["trigger"] = {"message": heard["sent"]["message"], "from": 3, "seq": heard["sent"]["seq"]}

    edit_lines(directory / "agents" / "1.trace.jsonl", take)
    assert "although no message could pass this link then" in found(directory)


def test_message_handled_twice_is_found(directory: Path) -> None:
    def repeat(lines: list[Document]) -> None:
        number = next(number for number, line in enumerate(lines) if line.get("handler", "").startswith("receive_"))
        lines.insert(number + 1, lines[number])

    edit_lines(directory / "agents" / "1.trace.jsonl", repeat)
    assert "again, although nothing duplicates messages" in found(directory)


def test_event_with_another_timestamp_is_found(directory: Path) -> None:
    def shift(lines: list[Document]) -> None:
        line = next(line for line in lines if "event" in line.get("trigger", {}))
        event = bytearray(base64.b64decode(line["input"]))
        event[:8] = (int.from_bytes(event[:8], "big") + 5_000_000).to_bytes(8, "big")
        line["input"] = base64.b64encode(event).decode()

    edit_lines(directory / "agents" / "1.trace.jsonl", shift)
    assert "but the timestamp of the event is" in found(directory)


def test_event_before_the_epoch_of_its_clock_agrees(tmp_path: Path) -> None:
    clocked = scenario(clocks={1: {"offset_s": -100, "drift": 0.01}}, events={"source": "random", "mean_s": 6})

    finished = run(clocked, 1, tmp_path / "run", SilentProgress(), backend="sim")

    assert finished.result.beside["records"].verdict == "agree", finished.result.beside["records"].evidence


def test_message_that_a_restarted_agent_cannot_confirm_is_not_lost(tmp_path: Path) -> None:
    """A restarted agent of a secured mission drops the first messages of each other agent, and requests a proof that
    they are new.
    """
    timeline = [{"at_s": 60, "kill": [3]}, {"at_s": 90, "restart": [3]}]
    often = {"source": "random", "mean_s": 6}
    asked = scenario(agents=3, duration_s=150, security={}, events=often, timeline=timeline)

    finished = run(asked, 1, tmp_path / "run", SilentProgress(), backend="sim")

    assert finished.result.beside["records"].verdict == "agree", finished.result.beside["records"].evidence


def test_store_that_no_agent_wrote_is_reported(directory: Path) -> None:
    text = json.dumps({"changes": [], "blocks": [], "secured": 5}).encode()
    header = b'{"schema":"ucp-store/1"}'
    lines = b"".join(b"%08x %s\n" % (zlib.crc32(line), line) for line in (header, text))
    (directory / "agents" / "1.store").write_bytes(lines)
    assert "its store 1.store is damaged" in found(directory)


def test_store_with_other_blocks_than_the_export_is_reported(directory: Path) -> None:
    header = b'{"schema":"ucp-store/1"}'
    (directory / "agents" / "1.store").write_bytes(b"%08x %s\n" % (zlib.crc32(header), header))
    assert "its store and its export differ in the chain" in found(directory)


def test_store_that_is_a_fifo_is_not_read(directory: Path) -> None:
    os.mkfifo(directory / "agents" / "1.store")
    assert "its store 1.store is not a file" in found(directory)


CONDITIONS = [{"loss": 0.3}, {"loss": 0.3, "duplicate": 0.1}, {"loss": 0.9, "duplicate": 0.6}]


@pytest.fixture(scope="module", params=CONDITIONS, ids=str)
def honest(request: pytest.FixtureRequest) -> Evidence:
    """Return the evidence of a run in memory in which the agents receive every message that the network does not
    lose.
    """
    asked = scenario(network=request.param, duration_s=1200, final_reconcile=True)
    evidence = simulate(asked, 1, tracing=True, deliver_all=True).evidence
    return replace(evidence, delivers_all=True)


def kept(trace: Trace, which: Iterator[bool]) -> Trace:
    """Return the trace without some of the received messages. For each received message in order, `which` states
    whether it remains.
    """
    runs = [run for run in trace.runs if not isinstance(run.trigger, MessageTrigger) or next(which)]
    return replace(trace, runs=runs)


def found_losses(evidence: Evidence) -> list[str]:
    return [contradiction.finding.detail for contradiction in _losses.compare(evidence)]


def test_correct_run_in_memory_agrees_with_its_loss_rate(honest: Evidence) -> None:
    assert found_losses(honest) == found_losses(replace(honest, delivers_all=False)) == []


def test_run_in_memory_that_discards_messages_is_found(honest: Evidence) -> None:
    which = cycle([True] * 6 + [False])
    discarding = {agent_id: kept(trace, which) for agent_id, trace in honest.traces.items()}
    (detail, *_) = found_losses(replace(honest, traces=discarding))
    assert "of them are lost" in detail


def test_run_in_memory_with_another_loss_rate_is_found(honest: Evidence) -> None:
    less = [(at_s, {link: loss / 2 for link, loss in losses.items()}) for at_s, losses in honest.link_losses]
    assert "of them are lost" in found_losses(replace(honest, link_losses=less))[0]


def test_more_messages_than_the_loss_rate_allows_are_found(honest: Evidence) -> None:
    more = [(at_s, {link: (1 + loss) / 2 for link, loss in losses.items()}) for at_s, losses in honest.link_losses]
    if more != honest.link_losses:
        assert "of them are lost" in found_losses(replace(honest, link_losses=more))[0]


def test_message_over_a_partition_is_expected_from_no_second_copy() -> None:
    asked = scenario(
        network={"loss": 0.2, "duplicate": 0.5},
        duration_s=900,
        timeline=[{"at_s": 100, "partition": [[1, 2]]}, {"at_s": 800, "heal": True}],
    )
    assert found_losses(simulate(asked, 1, tracing=True).evidence) == []
