"""Test which handler runs the checker assigns to the messages of a rogue node."""

import json
from pathlib import Path
from typing import Any

from harness.archive.archive import RunArchive
from harness.archive.run_record import RogueInjection
from harness.archive.traces import Trace, TraceHeader
from harness.checker.injections import account, in_words
from harness.play.rogue.rogue_line import forged_sequence
from tests.harness.virtual import scenario
from ucp.trace import HandlerRun, StateSummary
from ucp.trigger import MessageTrigger

STATE = StateSummary(0, 0, 0, reconciling=False, idle=True, top="")
TWICE = scenario(timeline=[{"at_s": 20, "replay": {}}, {"at_s": 30, "replay": {}}])
FLOOD = scenario(timeline=[{"at_s": 20, "flood": {"for_s": 10, "per_s": 1}}])


def trace(agent: int, *runs: tuple[float, int, str], changes: bool = False) -> Trace:
    """Return a trace of handler runs that Commit Blocks of agent 1 triggered. Each item is (time, sequence number,
    branch).
    """
    triggered = [
        HandlerRun(
            t,
            "receive_commit_block",
            6,
            MessageTrigger("Commit Block", 1, sequence),
            branch,
            [("chain+", "00")] if changes else [],
            [],
            STATE,
        )
        for t, sequence, branch in runs
    ]
    return Trace(TraceHeader(agent_id=agent, roster=[1, 2, 3, 4], settings={}, clock={}), triggered)


def line(at_s: float, injection: int, **keys: Any) -> dict[str, Any]:
    return {"at_s": at_s, "injection": injection, "what": "replay", "bytes": 50, **keys}


def copy(at_s: float, injection: int) -> dict[str, Any]:
    return line(at_s, injection, message="Commit Block", sender=1, sequence=7)


def accounted(directory: Path, one: Any, lines: list[dict[str, Any]], *traces: Trace) -> list[RogueInjection]:
    (directory / "rogue.jsonl").write_text("".join(json.dumps(it) + "\n" for it in lines) + "{half a li")
    (directory / "run.json").touch()
    archive = RunArchive(directory)
    archive.traces = {trace.header.agent_id: trace for trace in traces}
    return account(one, archive)


def test_last_runs_with_the_same_message_belong_to_the_copies(tmp_path: Path) -> None:
    whole = trace(2, (10, 7, "original"), (20.1, 7, "first"), (30.1, 7, "second"))
    first, second = accounted(tmp_path, TWICE, [copy(20, 1), copy(30, 2)], whole)
    assert (first.messages[0].handled, second.messages[0].handled) == ({"first": 1}, {"second": 1})


def test_agent_without_a_copy_is_not_counted(tmp_path: Path) -> None:
    died_before = trace(2, (10, 7, "original"))
    died_between = trace(3, (10, 7, "original"), (20.1, 7, "first"))
    missed_the_original = trace(4, (20.1, 7, "first"), (30.1, 7, "second"))
    traces = (died_before, died_between, missed_the_original)
    first, second = accounted(tmp_path, TWICE, [copy(20, 1), copy(30, 2)], *traces)
    assert (first.messages[0].handled, second.messages[0].handled) == ({"first": 2}, {"second": 1})
    (unheard, _) = accounted(tmp_path, TWICE, [copy(20, 1), copy(20, 1)], died_before)
    assert (unheard.sent, unheard.messages[0].unhandled, unheard.messages[0].handled) == (2, 2, {})
    assert in_words(unheard) == "replay at 20 s, the last 1 of every message: 2 sent; 2 handled by no agent"


def test_forged_message_is_recognised_by_its_sequence_number(tmp_path: Path) -> None:
    counted = line(20, 1, what="flood", count=3, messages={"Commit Block": 2}, refused={"truncated": 1})
    forged = [(20.1, forged_sequence(1, 0), "no"), (20.2, forged_sequence(1, 1), "committed"), (20.3, 5, "an agent's")]
    (flood,) = accounted(tmp_path, FLOOD, [counted], trace(2, *forged, changes=True))
    (messages,) = flood.messages
    assert (messages.sent, messages.handled, messages.changed) == (2, {"no": 1, "committed": 1}, 2)
    assert (flood.sent, messages.unhandled, flood.refused) == (3, 0, {"truncated": 1})


def test_counted_copies_are_reported_as_indistinguishable(tmp_path: Path) -> None:
    counted = line(20, 1, count=2, messages={"Commit Block": 2}, refused={})
    first, _ = accounted(tmp_path, TWICE, [counted], trace(2, (20.1, 7, "first")))
    assert (first.sent, first.untraced, first.messages[0].handled, first.messages[0].unhandled) == (2, 2, {}, 0)
    assert in_words(first).endswith("2 sent; 2 indistinguishable from their originals")


def test_indistinguishable_type_does_not_affect_another_type(tmp_path: Path) -> None:
    counted = line(20, 1, count=2, messages={"Block Response": 2}, refused={})
    first, _ = accounted(tmp_path, TWICE, [counted, copy(20, 1)], trace(2, (10, 7, "original")))
    unhandled = {of.message: of.unhandled for of in first.messages}
    assert unhandled == {"Block Response": 0, "Commit Block": 1}


def test_corrupted_message_of_a_secured_mission_is_never_handled(tmp_path: Path) -> None:
    for_s = {"for_s": 10}
    secured = scenario(security={"keys": "fresh"}, timeline=[{"at_s": 20, "corrupt": for_s}])
    corrupted = line(20, 1, what="corrupt", message="Commit Block", sender=1, sequence=7)
    (alone,) = accounted(tmp_path, secured, [corrupted], trace(2, (20, 7, "committed"), changes=True))
    assert (alone.messages[0].handled, alone.messages[0].changed, alone.messages[0].unhandled) == ({}, 0, 1)
    twice = scenario(security={"keys": "fresh"}, timeline=[{"at_s": 20, "duplicate": for_s}])
    duplicate = corrupted | {"what": "duplicate"}
    (copied,) = accounted(tmp_path, twice, [duplicate], trace(2, (20, 7, "committed")))
    assert (copied.untraced, copied.messages[0].handled, copied.messages[0].unhandled) == (1, {}, 0)
