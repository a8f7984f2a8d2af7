"""Test recorded runs against the specification: it allows all steps of correct agents, but not those of wrong ones."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from harness.proof.specification import RunTraces, TraceValidation, recorded, simulated, validate
from harness.scenario.load import parse
from tests.harness.command import harness, sentences, write_scenario
from tests.machine import require_tlc

SHORT = {"agents": 3, "duration_s": 100, "network": {"loss": 0.3}, "events": {"source": "random", "mean_s": 4}}
WRONG = {"forget_own_vote": 2, "approve_everything": 3, "never_pop": 11}
"""The Algorithm to which each deliberate error belongs."""


@pytest.fixture(autouse=True)
def _tlc() -> None:
    require_tlc()


def of(name: str, **keys: Any) -> RunTraces:
    [run] = simulated(parse({"name": name, **SHORT, **keys}), [2])
    return RunTraces(name, run.traces, run.ended)


@pytest.fixture(scope="module")
def validation() -> TraceValidation:
    """Validate the traces of correct and wrong agents in one call."""
    require_tlc()
    lost = [{"at_s": 30, "reboot": [2], "down_s": 5, "disk": "kept"}, {"at_s": 40, "kill": [3]}]
    right = [
        of("lossy", final_reconcile=True),
        of("reboot", timeline=[*lost, {"at_s": 60, "restart": [3]}]),
        of("lossless", network={"loss": 0}),
    ]
    wrong = [of(quirk, quirks={quirk: True}, duration_s=200) for quirk in WRONG]
    return validate([*right, *wrong])


def test_only_wrong_agents_deviate_from_the_specification(validation: TraceValidation) -> None:
    assert not validation.unread
    assert validation.runs == 3 + len(WRONG)
    assert validation.steps > 1000
    assert {rejected.run for rejected in validation.rejected} == WRONG.keys()


def test_wrong_agent_is_rejected_with_line_and_handler(validation: TraceValidation) -> None:
    for rejected in validation.rejected:
        assert f"line {rejected.line}, Algorithm {WRONG[rejected.run]}, " in rejected.in_words()
        assert rejected.line > 1
    assert validation.exit_status == 1


def test_unchecked_records_are_reported_beside_rejected_steps(tmp_path: Path) -> None:
    [run] = simulated(parse({"name": "short", **SHORT}), [1])
    trace = run.traces[0]
    header = {"schema": "ucp-trace/2", **trace.header.model_dump(exclude={"schema_"})}
    lines = [json.dumps(header) + "\n", *(entry.to_line() for entry in trace.runs)]
    damaged, wrong = tmp_path / "damaged.jsonl", tmp_path / "wrong.jsonl"
    damaged.write_text("".join([*lines[:20], '{"t": "soon"}\n', *lines[20:]]))
    wrong.write_text("".join([*lines[:20], lines[20].replace('"chain":', '"chain":9'), *lines[21:]]))
    done = harness("validate", damaged, wrong, "--json")
    assert done.returncode == 1
    document = json.loads(done.stdout)
    assert document["unread"] == [f"{damaged}: agent 1: line 21 is damaged"]
    [rejected] = document["rejected"]
    assert (rejected["run"], rejected["agent_id"], rejected["line"]) == (str(wrong), 1, 21)
    assert rejected["what"] == ["the state after it"]
    assert document["steps"] == 19 + 20


def test_incomplete_exploration_does_not_hold() -> None:
    assert TraceValidation(1, 1, 19, unread=["1.trace.jsonl: agent 1: line 21 is damaged"]).exit_status == 2
    assert TraceValidation(1).exit_status == 2


def test_interrupt_keeps_all_earlier_results() -> None:
    def runs() -> Iterator[RunTraces]:
        yield RunTraces("first", [], problems=["no traces found"])
        raise KeyboardInterrupt

    validation = validate(runs())
    assert validation.interrupted
    assert validation.unread == ["first: no traces found"]
    assert validation.exit_status == 130


@pytest.mark.lab
def test_agents_as_processes_follow_the_specification(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = harness("run", write_scenario(tmp_path, network={"loss": 0.2}), "--seed", 3, "--out", out)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    validation = validate(recorded([out]))
    assert (validation.lives, validation.rejected, validation.unread) == (3, [], [])
    assert validation.steps > 10


def test_records_without_steps_do_not_count_as_checked() -> None:
    nothing = TraceValidation(runs=1, unread=["1.chain.json: no traces found"])
    *_, last = nothing.in_words()
    assert last == "- 1 run, 0 lives of agents, 0 handler runs: nothing could be checked"


def test_path_without_a_run_gives_one_sentence(tmp_path: Path) -> None:
    done = harness("validate")
    assert done.returncode == 2
    assert "validate needs recorded runs, or a --scenario to play" in done.stderr
    done = harness("validate", tmp_path / "nowhere")
    assert done.returncode == 2
    [sentence] = sentences(done.stderr)
    assert "nowhere" in sentence
