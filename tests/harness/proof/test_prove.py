"""Test the results of `prove`, their confirmation by the simulation, and the output of the command."""

import json
import multiprocessing
import os
import signal
import subprocess
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

from harness.errors import INCOMPLETE, INTERRUPTED
from harness.proof import Bounds, BoundsError, ExplorationProgress, Limits, in_words, prove
from harness.proof._progress_bar import memory_bytes
from harness.proof.graph._exploration import LOOK_EVERY, explore
from harness.proof.graph._workers import Workers
from harness.proof.model._any_sender import collect
from harness.proof.model._global_states import ModelSwarm
from harness.scenario.agent_options import Stagger
from tests.harness.command import COMMAND, harness, sentences


def test_proof_finds_the_livelock_in_step(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 4, "lossless"), out=tmp_path / "in_step.yaml")
    assert proof.flaw is None
    assert proof.liveness is not None
    assert proof.liveness.lost is None
    assert proof.example is not None
    assert proof.example.judged["liveness"].verdict == "never finishes"
    assert "drop" not in proof.example.path.read_text()
    assert proof.exit_status == 1


def test_all_properties_hold_with_fewer_blocks(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 2, "lossy"), out=tmp_path / "none.yaml")
    assert proof.exit_status == 0
    assert proof.example is None
    assert proof.fork is not None
    assert [*tmp_path.iterdir()] == [proof.fork.path]
    assert (proof.fork.judged, proof.fork.chains) == ({}, 2)
    assert not [line for line in in_words(proof) if line.startswith(("✘", "-"))]


@pytest.mark.parametrize(
    ("quirk", "kind", "key"),
    [("forget_stack", "2", "2"), ("commit_others_twice", "3", "3"), ("leave_flag_set", "hang", "liveness")],
)
def test_wrong_agent_is_found_and_its_scenario_confirms_it(tmp_path: Path, quirk: str, kind: str, key: str) -> None:
    """The prover reduces no states of a wrong agent, although the bounds allow reductions."""
    proof = prove(Bounds(2, 2, "lossy", quirks={quirk: True}), out=tmp_path / "wrong.yaml")
    assert not proof.bounds.reduced
    assert proof.flaw is not None
    assert proof.flaw.kind == kind
    assert proof.example is not None
    assert key in proof.example.judged


def test_scenario_forces_the_order_of_messages_that_cross(tmp_path: Path) -> None:
    """A commit and a request reach agent 3 at the same time. The commit is first, so the agent rejects the requested
    block.
    """
    bounds = Bounds(3, 2, "lossy", quirks={"disapproved_and_unmoved": True}, reduced=False, losses=1)
    proof = prove(bounds, out=tmp_path / "wrong.yaml")
    assert proof.flaw is not None
    assert proof.flaw.kind == "2"
    assert proof.example is not None
    assert proof.example.judged["2"].verdict == "violated"


@pytest.mark.parametrize(
    ("quirk", "handler"),
    [
        ("propose_during_vote", "process_next_deque_block"),
        ("hasty_vote", "process_next_deque_block"),
        ("approve_everything", "receive_request_add_block"),
        ("hide_commits", "vote_timer_expiration"),
        ("skip_phase2", "reconcile_phase_1_timer_expiration"),
    ],
)
def test_wrong_step_without_consequence_is_found(tmp_path: Path, quirk: str, handler: str) -> None:
    bounds = Bounds(2, 2, "lossy", quirks={quirk: True}, reduced=False, steps=True)
    proof = prove(bounds, out=tmp_path / "wrong.yaml")
    assert proof.flaw is not None
    assert (proof.flaw.kind, proof.flaw.handler) == ("steps", handler)
    assert proof.example is not None
    assert proof.example.judged["steps"].verdict == "deviates"
    assert handler in proof.example.judged["steps"].reason


def test_timer_that_was_not_stopped_is_found_before_it_expires(tmp_path: Path) -> None:
    """The record of a run would show this timer only when it expires."""
    bounds = Bounds(2, 2, "lossy", quirks={"phase3_timer_runs_on": True}, reduced=False, steps=True)
    proof = prove(bounds, out=tmp_path / "wrong.yaml")
    assert proof.flaw is not None
    assert proof.flaw.handler == "receive_response_block_for_hash"
    assert proof.example is not None
    assert "reconcile_phase_3_timer_expiration" in proof.example.judged["steps"].reason


def test_wrong_step_on_a_late_message_is_found() -> None:
    bounds = Bounds(2, 2, "any", quirks={"pause_without_resume": True}, reduced=False, steps=True)
    collected = collect(bounds, most_bytes=8e9, most_s=600)
    assert collected.flaw is not None
    assert collected.flaw.handler == "receive_response_block_for_hash"
    assert collected.way[-1] == "it hears a Block Response from agent 1"
    counted = (collected.states, collected.looked_at, collected.said, collected.local_states, collected.steps)
    assert min(*counted, collected.zones) > 0, "a proof that ends early counts the states that it has seen"


def test_flaw_that_the_scenario_does_not_show_is_reported(tmp_path: Path) -> None:
    bounds = Bounds(2, 2, "lossy", quirks={"forget_stack": True}, reduced=False)
    proof = prove(bounds, out=tmp_path / "wrong.yaml")
    assert proof.example is not None
    assert not any("not confirmed: the simulation" in line for line in in_words(proof))
    proof.example = replace(proof.example, judged={})
    assert any("not confirmed: the simulation" in line for line in in_words(proof))


@pytest.mark.parametrize("stagger", [{}, {"phase1_timeout_s": 0.5}])
def test_each_step_of_correct_agents_is_correct(stagger: Stagger, tmp_path: Path) -> None:
    proof = prove(Bounds(2, 2, "lossy", ("reboot",), steps=True, stagger=stagger), out=tmp_path / "steps.yaml")
    assert proof.exit_status == 0
    assert any("every step" in line and line.startswith("✔") for line in in_words(proof))


def test_memory_limit_concerns_present_memory() -> None:
    before = memory_bytes()
    once = b"x" * 500_000_000
    assert memory_bytes() > before + 400_000_000
    del once
    assert memory_bytes() < before + 100_000_000


def test_property_of_unexplored_states_never_holds(tmp_path: Path) -> None:
    proof = prove(Bounds(3, 3, "lossy"), Limits(most_s=0.0), tmp_path / "none.yaml")
    assert proof.exit_status == INCOMPLETE
    assert not any("✔" in line for line in in_words(proof))
    assert (
        "the same bounds with --losses 1 or --coincidences 0 or --no-crossing or --clocks any or --zones contained"
        in [*in_words(proof)][2]
    )
    least = Bounds(4, 4, "lossy", losses=2, coincidences=0, clocks_any=True, crossing=False)
    proof = prove(least, Limits(most_s=0.0), tmp_path / "least.yaml")
    assert proof.ended == "time"
    assert not any("sooner" in line for line in in_words(proof))
    bounds = Bounds(3, 3, "lossless", stagger={"phase1_timeout_s": 0.5})
    staggered = prove(bounds, Limits(most_s=0.0), tmp_path / "staggered.yaml")
    assert [*in_words(staggered)][2].endswith(
        "the same bounds with --coincidences 0 or --no-crossing or --clocks any or --zones contained"
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"agents": 0},
        {"settings": {"a": 1}},
        {"quirks": {"a": True}},
        {"faults": ("a",)},
        {"losses": -1},
        {"losses": 10},
        {"losses": 1, "network": "lossless"},
        {"losses": 1, "network": "any"},
    ],
)
def test_impossible_bounds_end_with_one_sentence(wrong: dict[str, object]) -> None:
    with pytest.raises(BoundsError):
        Bounds(**wrong)  # type: ignore[arg-type]


def test_command_prints_the_proof(tmp_path: Path) -> None:
    held = harness("prove", "--blocks", 1, "--json", cwd=tmp_path)
    assert held.returncode == 0
    assert json.loads(held.stdout)["complete"] is True
    wrong = harness("prove", "--settings", "vote_timeout_s=-1", cwd=tmp_path)
    assert wrong.returncode == 2
    assert [sentence.split()[0] for sentence in sentences(wrong.stderr)] == ["vote_timeout_s"]


def test_ctrl_c_prints_the_progress(tmp_path: Path) -> None:
    scenario = tmp_path / "begun" / "proof.yaml"
    command = [*COMMAND, "prove", "--agents", "5", "--blocks", "5", "--json", "--out", str(scenario)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not scenario.parent.exists():
            time.sleep(0.05)
        time.sleep(0.5)  # the proof takes minutes
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    proof = json.loads(out)
    assert process.returncode == INTERRUPTED
    assert (proof["complete"], proof["ended"], proof["without_a_way_to_one_chain"]) == (False, "interrupted", None)
    assert sentences(err) == ["interrupted"]
    assert not scenario.exists()


def test_interrupted_workers_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(progress: ExplorationProgress) -> None:
        assert multiprocessing.active_children()
        raise KeyboardInterrupt

    monkeypatch.setattr("harness.proof.graph._workers.WORTH_WORKERS", 10)
    swarm = ModelSwarm(Bounds(3, 3, "lossy"))
    with Workers(swarm, 2) as workers:
        graph = explore(swarm, most_bytes=8e9, most_s=600, workers=workers, watch=interrupt)
    assert graph.ended == "interrupted"
    assert graph.looked_at == LOOK_EVERY
    assert not multiprocessing.active_children()


def test_ctrl_c_during_the_start_of_workers_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Press Ctrl-C while worker processes are forked. Python ignores exceptions in functions that it calls at a
    fork.
    """
    interruptions = [signal.SIGINT]
    os.register_at_fork(before=lambda: signal.raise_signal(interruptions.pop()) if interruptions else None)
    monkeypatch.setattr("harness.proof.graph._workers.WORTH_WORKERS", 10)
    swarm = ModelSwarm(Bounds(2, 3, "lossy"))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores SIGINT
    try:
        with Workers(swarm, 2) as workers:
            graph = explore(swarm, most_bytes=8e9, most_s=600, workers=workers)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not interruptions
    assert graph.ended == "interrupted"


def test_limits_also_concern_questions_to_the_whole_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        import_module("harness.proof._proof"), "explore", lambda *_, **__: replace(explored, seconds=61.0)
    )
    explored = explore(ModelSwarm(Bounds(2, 2, "lossy")), most_bytes=8e9, most_s=600)
    proof = prove(Bounds(2, 2, "lossy"), Limits(most_bytes=8e9, most_s=60), tmp_path / "none.yaml")
    assert (proof.ended, proof.whole_ended, proof.exit_status) == ("complete", "time", INCOMPLETE)
    assert [line[0] for line in in_words(proof) if "one chain" in line or "livelock" in line] == ["-", "-"]


def test_progress_shows_the_question_to_the_whole_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.proof._progress_bar.LOOK_EVERY_S", 0.0)
    reports: list[ExplorationProgress] = []
    proof = prove(Bounds(2, 3, "lossless"), out=tmp_path / "asked.yaml", watch=reports.append)
    assert proof.liveness is not None
    asked = dict.fromkeys(progress.asked for progress in reports if progress.asked is not None)
    forks = proof.liveness.forks
    assert forks
    assert [*asked][:3] == ["idle states", "cycles", "paths to one chain"]
    assert [*asked][3:] == [f"what votes lead to ({known} of {forks} forks)" for known in range(forks)]
    assert {(progress.states, progress.looked_at) for progress in reports if progress.asked is not None} == {
        (proof.figures.states, proof.figures.states)
    }


def take_long(*_: object) -> None:
    time.sleep(20)
    raise RuntimeError("nobody has stopped it")


def test_time_limit_ends_a_long_question_about_one_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.proof.graph._workers.WORTH_WORKERS", 10)
    monkeypatch.setattr("harness.proof.graph._workers.WAIT_S", 0.01)
    monkeypatch.setattr("harness.proof.graph._workers.expanded", take_long)
    swarm = ModelSwarm(Bounds(3, 3, "lossy"))
    with Workers(swarm, 2) as workers:
        graph = explore(swarm, most_bytes=8e9, most_s=0.5, workers=workers)
    assert graph.ended == "time"
    assert not multiprocessing.active_children()


def test_network_any_checks_each_agent_against_all_messages(tmp_path: Path) -> None:
    proof = prove(Bounds(2, 2, "any", ("reboot",)), out=tmp_path / "none.yaml")
    assert proof.exit_status == 0
    assert any("not checked" in line for line in in_words(proof))
    wrong = prove(Bounds(2, 2, "any", quirks={"commit_others_twice": True}, reduced=False), out=tmp_path / "wrong.yaml")
    assert wrong.flaw is not None
    assert wrong.flaw.kind == "3"
    assert wrong.way[-1].startswith("it hears a Commit Block")
    assert wrong.example is not None
    assert wrong.example.judged["3"].verdict == "violated"
