"""Test `ucp-harness diff`. Two runs with the same seed have no difference."""

import hashlib
import json
import re
import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from harness.errors import RunDirectoryError
from harness.play.progress import SilentProgress
from harness.report.difference import AgentDifference, ChainDifference, KeyDifference, compare, differing_keys
from harness.run.run import run
from harness.scenario import load_scenario
from tests.harness.command import harness, sentences
from tests.harness.mission import edit, edit_lines
from tests.harness.virtual import scenario

LOST_LAST_COMMIT = Path(__file__).parents[3] / "scenarios" / "lost_last_commit.yaml"
SAME = AgentDifference(None, None)


def fly(out: Path, seed: int = 1, **keys: Any) -> Path:
    """Play a run in virtual time. By default, three agents run for five minutes."""
    run(scenario(**{"agents": 3, "duration_s": 300, **keys}), seed, out, SilentProgress(), "sim")
    return out


@pytest.fixture
def a(tmp_path: Path) -> Path:
    return fly(tmp_path / "a", network={"loss": 0.2})


@pytest.fixture
def b(a: Path) -> Path:
    """Return a copy of the run `a`, which a test may change."""
    return Path(shutil.copytree(a, a.with_name("b")))


def trace(run_dir: Path, agent: int = 2) -> Path:
    return run_dir / "agents" / f"{agent}.trace.jsonl"


def test_runs_of_the_same_seed_are_identical(a: Path, tmp_path: Path) -> None:
    again = fly(tmp_path / "again", network={"loss": 0.2})
    done = harness("diff", a, again)
    assert (done.returncode, done.stderr) == (0, "")
    lines = sum(trace(a, agent).read_text().count("\n") - 1 for agent in (1, 2, 3))
    assert done.stdout == f"identical to the last byte: {lines} handler runs of 3 agents, and their chains\n"


def test_diff_finds_the_one_lost_commit(tmp_path: Path) -> None:
    lossy = load_scenario(LOST_LAST_COMMIT)
    without, with_it = tmp_path / "a", tmp_path / "b"
    run(lossy, 1, without, SilentProgress(), "sim")
    run(lossy.model_copy(update={"fates": []}), 1, with_it, SilentProgress(), "sim")
    found = compare(without, with_it)
    assert (found.verdict, found.first) == ("differ", 2)
    assert [(one.key, one.b) for one in found.keys] == [("fates", [])]
    difference = found.agents.pop(2)
    assert set(found.agents.values()) == {SAME}
    assert difference.chain == ChainDifference(4, None, "4.2")
    assert difference.run is not None and difference.run.a is None and difference.run.b is not None
    assert (difference.run.b.handler, difference.run.b.branch) == ("receive_commit_block", "committed")
    assert difference.run.b.trigger.to_json()["from"] == 4
    assert ("chain+", "4.2") in difference.run.b.changes
    assert 117 < difference.run.at_s < 130


def test_differing_runs_have_status_1_with_keys_before_agents(a: Path, tmp_path: Path) -> None:
    other = fly(tmp_path / "other", seed=2, network={"loss": 0.3})
    done = harness("diff", a, other)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert lines[:2] == ["seed: 1 in A, 2 in B", "network.loss: 0.2 in A, 0.3 in B"]
    assert re.fullmatch(r"the runs differ first at [\d.]+ s, at agent [123]", lines[2])
    assert [line for line in lines if line.startswith("agent ")] == ["agent 1:", "agent 2:", "agent 3:"]
    assert re.search(r"^    A  [\d.]+ s \(line \d+\): \w+, .+; .+$", done.stdout, re.MULTILINE)


def test_json_holds_the_first_difference(a: Path, b: Path) -> None:
    edit_lines(trace(b), lambda lines: lines[5].update(branch="another"))
    done = harness("diff", a, b, "--json")
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert (found["verdict"], found["first"], found["keys"]) == ("differ", 2, [])
    assert found["agents"]["1"] == {"run": None, "chain": None}
    first = found["agents"]["2"]["run"]
    assert (first["number"], first["a"]["line"], first["b"]["branch"]) == (5, 6, "another")


def test_times_and_hashes_of_the_same_blocks_are_not_compared(a: Path, b: Path) -> None:
    """Times and hashes always differ between two runs with real processes."""
    for path in (b / "agents").glob("*.json*"):
        text = re.sub(
            r"\b[0-9a-f]{64}\b", lambda found: hashlib.sha256(found[0].encode()).hexdigest(), path.read_text()
        )
        path.write_text(re.sub(r'"t":([\d.]+)', lambda found: f'"t":{float(found[1]) + 0.25}', text))
    done = harness("diff", a, b)
    assert done.returncode == 0
    assert re.fullmatch(
        r"the same: \d+ handler runs of 3 agents, and their chains; they differ only in .*, which are not "
        r"compared\n",
        done.stdout,
    )


def test_edited_state_is_reported_as_a_difference_in_states(a: Path, b: Path) -> None:
    trace(b).write_text(trace(b).read_text().replace('"deque":0', '"deque":7', 1))
    done = harness("diff", a, b)
    assert done.returncode == 0
    differences = "times, in hashes that cover times, in tallies or in states"
    assert f"; they differ only in {differences}, which are not compared" in done.stdout


@pytest.mark.parametrize(
    "change",
    [
        lambda step: step.update(handler="another"),
        lambda step: step.update(branch="another"),
        lambda step: step.update(trigger={"message": "Commit Block", "from": 1, "seq": 99}),
        lambda step: step.update(sent=[{"message": "Commit Block", "seq": 1, "block": None}]),
        lambda step: step.update(changes=[["stack+", "00" * 32]]),
    ],
    ids=["handler", "branch", "trigger", "sent", "changes"],
)
def test_each_action_of_an_agent_is_compared(a: Path, b: Path, change: Any) -> None:
    edit_lines(trace(b), lambda lines: change(lines[3]))
    found = compare(a, b)
    assert found.first == 2
    assert found.agents[2].run is not None and found.agents[2].run.number == 3
    assert found.agents[1] == found.agents[3] == SAME


def test_first_differing_agent_is_the_earliest_in_mission_time(a: Path, b: Path) -> None:
    edit_lines(trace(b, 1), lambda lines: lines[9].update(branch="another"))
    edit_lines(trace(b, 3), lambda lines: lines[9].update(branch="another", t=1.5))
    found = compare(a, b)
    assert found.first == 3
    assert found.agents[3].run is not None and found.agents[3].run.at_s == 1.5


def test_additional_incarnation_of_an_agent_is_a_difference(a: Path, b: Path) -> None:
    lines = trace(b).read_text().splitlines(keepends=True)
    trace(b).write_text("".join([*lines[:4], lines[0], *lines[4:]]))
    found = compare(a, b)
    assert found.first == 2
    first = found.agents[2].run
    assert first is not None and first.a is not None and first.b is not None
    assert (first.number, first.a.life, first.b.life, first.b.line) == (4, 1, 2, 6)


def test_incomplete_last_line_of_a_killed_agent_is_ignored(a: Path, b: Path) -> None:
    for run_dir in (a, b):
        with trace(run_dir).open("a") as file:
            file.write('{"t":' if run_dir is a else '{"t":12,"handler":"x')
    assert compare(a, b).verdict == "identical"


def test_innermost_keys_differ_and_lists_of_other_lengths_as_a_whole() -> None:
    one = {"network": {"loss": 0.1, "delay": 1}, "timeline": [{"at_s": 1}], "fates": [1], "name": "x"}
    other = {"network": {"loss": 0.2, "delay": 1}, "timeline": [{"at_s": 2}], "fates": [], "name": "x", "more": True}
    assert [*differing_keys(one, other)] == [
        KeyDifference("network.loss", 0.1, 0.2),
        KeyDifference("timeline.0.at_s", 1, 2),
        KeyDifference("fates", [1], []),
        KeyDifference("more", None, True),
    ]


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (
            lambda b: trace(b).unlink(),
            "2.trace.jsonl: cannot be read (No such file or directory), and a comparison needs it",
        ),
        (lambda b: trace(b).write_text(""), "2.trace.jsonl: it is empty"),
        (lambda b: trace(b).write_text(trace(b).read_text() + "{}\n"), "is damaged, or of another version of traces"),
        (lambda b: edit_lines(trace(b), lambda lines: lines[0].update(schema="ucp-trace/3")), "line 1 is damaged, or"),
        (
            lambda b: edit(b / "run.json", lambda it: it.update(roster=[1, 2])),
            "A has agents 1\u20133, but B has 1, 2: compare runs of the same agents",
        ),
        (lambda b: edit(b / "run.json", lambda it: it.update(backend="process")), "compare runs of the same backend"),
        (lambda b: edit(b / "run.json", lambda it: it.pop("roster")), "it names no agents"),
        (lambda b: (b / "run.json").unlink(), "is this a run directory?"),
    ],
)
def test_runs_that_cannot_be_compared_are_refused(a: Path, b: Path, damage: Any, sentence: str) -> None:
    damage(b)
    with pytest.raises(RunDirectoryError, match=re.escape(sentence)):
        compare(a, b)


def test_refused_comparison_has_status_2_and_one_sentence(a: Path, tmp_path: Path) -> None:
    done = harness("diff", a, tmp_path / "nowhere")
    assert (done.returncode, done.stdout, len(sentences(done.stderr))) == (2, "", 1)


def test_unreadable_export_is_reported_and_counts_as_no_chain(a: Path, b: Path) -> None:
    (b / "agents" / "2.chain.json").write_text("{")
    done = harness("diff", a, b)
    assert done.returncode == 1
    assert re.search(r"^  block 1 of its chain: \d\.1 in A, not there in B$", done.stdout, re.MULTILINE)
    assert "2.chain.json: truncated or damaged" in sentences(done.stderr)[0]


def test_run_without_a_recorded_end_is_compared_with_a_remark(a: Path, b: Path) -> None:
    edit(b / "run.json", lambda record: record.update(outcome="running"))
    done = harness("diff", a, b)
    assert done.returncode == 0
    assert sentences(done.stderr) == [
        f"{b}: the end of the run is not recorded, so the comparison covers the recorded part"
    ]


def test_diff_does_not_hold_a_whole_trace_in_memory(a: Path, b: Path) -> None:
    for run_dir in (a, b):
        header, *steps = trace(run_dir).read_text().splitlines(keepends=True)
        trace(run_dir).write_text(header + "".join(step for step in steps if '"complete"' not in step) * 200)
    with trace(b).open("a") as file:
        file.write(trace(a).read_text().splitlines(keepends=True)[1])
    size = trace(b).stat().st_size
    tracemalloc.start()
    found = compare(a, b)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.agents[2].run is not None and found.agents[2].run.a is None
    assert peak < size / 4
