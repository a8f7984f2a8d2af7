"""Test the search for a violation, the reduction of the run to a small scenario, and the file that repeats the run."""

import dataclasses
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from harness.checker import Result
from harness.errors import RunDirectoryError
from harness.run.simulate import simulate, simulated
from harness.scenario import Scenario, load_scenario
from harness.sweep.explore import Explored, explore, in_words
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.virtual import scenario

LOSSY = scenario(agents=4, duration_s=400, network={"loss": 0.1}, timeline=[{"at_s": 50, "loss": 0.2}])


def planted(result: Result, number: str) -> Result:
    one = dataclasses.replace(result.characteristics[number], verdict="violated", reason="planted")
    return Result({**result.characteristics, number: one}, result.figures)


def one_commit_is_lost(asked: Scenario, seed: int) -> Result:
    """Return a violation of characteristic 6 if chains differ. One lost Commit Block is enough for this."""
    result = simulated(asked, seed)
    return planted(result, "6") if result.figures["distinct_chains"] != 1 else result


def find(out: Path, asked: Scenario = LOSSY, jobs: int = 1, **options: Any) -> Explored:
    options = {"judge": one_commit_is_lost, **options}
    return explore(asked, range(20), out, source="lossy.yaml", jobs=jobs, **options)


def test_irrelevant_parts_are_left_out(tmp_path: Path) -> None:
    explored = find(tmp_path / "small.yaml")
    assert explored.exit_status == 1
    smallest = load_scenario(tmp_path / "small.yaml")
    assert len(smallest.roster) == 2
    assert len(smallest.events.script) == 1
    (fate,) = smallest.fates
    assert (fate.message, fate.drop) == ("Commit Block", True)
    assert not smallest.timeline
    assert smallest.network.loss == 0
    assert explored.searched.violation is not None
    assert one_commit_is_lost(smallest, explored.searched.violation.seed).bad == ("6",)


def test_file_explains_itself_in_comments(tmp_path: Path) -> None:
    explored = find(tmp_path / "small.yaml")
    assert explored.shrunk is not None
    text = (tmp_path / "small.yaml").read_text()
    header = [line for line in text.splitlines() if line.startswith("#")]
    assert header[0] == "# Characteristic 6, one uniform chain, is violated, planted"
    assert "Shrunk from lossy.yaml, seed" in header[1]
    assert " -> 2 agents, 1 event, 1 fate in " in header[1]
    assert header[2] == f"#   {explored.shrunk.replay}"
    assert "    - {at_s: 1, agent: " in text
    assert "count: 1, drop: true}  # sent at 11.000 s, block " in text
    assert len(text.splitlines()) < 20


def test_lowest_seed_is_found_and_shrunk_by_any_number_of_processes(tmp_path: Path) -> None:
    def from_seed_3_on(asked: Scenario, seed: int) -> Result:
        return one_commit_is_lost(asked, seed) if seed >= 3 else simulated(asked, seed)

    texts = set()
    for jobs in (1, 2):
        out = tmp_path / f"{jobs}.yaml"
        explored = find(out, jobs=jobs, judge=from_seed_3_on)
        assert explored.searched.violation is not None
        assert (explored.searched.violation.seed, explored.searched.played) == (3, 4)
        texts.add(out.read_text().replace(str(out), "FILE"))
    assert len(texts) == 1


def test_real_violation_is_played_again_from_the_file(tmp_path: Path) -> None:
    asked = scenario(agents=5, duration_s=600, network={"loss": 0.3}, quirks={"crash_on_tie": True})
    explored = find(tmp_path / "tie.yaml", asked, judge=simulated)
    assert explored.searched.violation is not None
    smallest = load_scenario(tmp_path / "tie.yaml")
    again = simulate(smallest, explored.searched.violation.seed, tracing=True)
    assert explored.searched.violation.keys[0] in again.result.bad
    assert not again.played.unmatched_fates
    assert len(smallest.roster) < 5
    assert len(smallest.events.script) < 10


def test_no_violation_writes_nothing(tmp_path: Path) -> None:
    explored = find(tmp_path / "none.yaml", judge=simulated)
    assert (explored.exit_status, explored.searched.played, explored.shrunk) == (0, 20, None)
    assert not list(tmp_path.iterdir())


def test_run_without_a_verdict_is_reported_with_status_1(tmp_path: Path) -> None:
    def fails(asked: Scenario, seed: int) -> Result:
        assert seed != 7, "a bug"
        return simulated(asked, seed)

    explored = find(tmp_path / "none.yaml", judge=fails)
    assert explored.exit_status == 1
    assert "a bug" in explored.searched.failed[7]


def test_runs_that_need_more_time_are_listed_with_status_4(tmp_path: Path) -> None:
    def needs_time(asked: Scenario, seed: int) -> Result:
        result = simulated(asked, seed)
        if seed not in (3, 7):
            return result
        return Result({"liveness": dataclasses.replace(result.judgements["liveness"], verdict="not finished")}, {})

    explored = find(tmp_path / "none.yaml", judge=needs_time)
    assert (explored.exit_status, explored.searched.unfinished, explored.shrunk) == (4, [3, 7], None)
    assert any(line.endswith("to be judged, seeds 3, 7") for line in in_words(explored))


def test_ctrl_c_while_shrinking_writes_the_smallest_so_far(tmp_path: Path) -> None:
    runs = 0

    def interrupted(asked: Scenario, seed: int) -> Result:
        nonlocal runs
        runs += 1
        if runs == 30:
            raise KeyboardInterrupt
        return one_commit_is_lost(asked, seed)

    explored = find(tmp_path / "small.yaml", judge=interrupted)
    assert explored.exit_status == 130
    assert explored.shrunk is not None
    assert "interrupted" in explored.shrunk.words
    smallest = load_scenario(tmp_path / "small.yaml")
    assert one_commit_is_lost(smallest, explored.shrunk.seed).bad == ("6",)


def test_ctrl_c_while_searching_writes_nothing(tmp_path: Path) -> None:
    def interrupted(asked: Scenario, seed: int) -> Result:
        raise KeyboardInterrupt

    explored = find(tmp_path / "none.yaml", judge=interrupted)
    assert (explored.exit_status, explored.shrunk) == (130, None)


def test_reached_limit_is_reported(tmp_path: Path) -> None:
    explored = find(tmp_path / "small.yaml", max_runs=10)
    assert explored.shrunk is not None
    assert "in 10 runs, when the bound was reached" in explored.shrunk.words
    smallest = load_scenario(tmp_path / "small.yaml")
    assert one_commit_is_lost(smallest, explored.shrunk.seed).bad == ("6",)


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "mine.yaml"
    out.write_text("mine")
    with pytest.raises(RunDirectoryError, match="existing files are not overwritten"):
        find(out)
    assert out.read_text() == "mine"


def test_message_dropped_by_a_fate_breaks_full_connectivity() -> None:
    dropped = [{"message": "Chain Contain Response", "receiver": 2, "from_s": 0, "until_s": 900, "drop": True}]
    events = {"source": "scripted", "script": [{"at_s": at, "agent": 1 + at % 2} for at in range(1, 800, 7)]}
    asked = scenario(agents=3, duration_s=800, events=events, fates=dropped, quirks={"ignore_commit": 0.5})
    simulated = simulate(asked, 1, tracing=True)
    assert simulated.evidence.connected_since_s is not None
    assert simulated.evidence.connected_since_s > 100


def test_command_prints_the_finding_and_how_to_play_it_again(tmp_path: Path) -> None:
    path, out = tmp_path / "tie.yaml", tmp_path / "small.yaml"
    path.write_text("name: tie\nagents: 4\nduration_s: 400\nnetwork: {loss: 0.3}\nquirks: {crash_on_tie: true}\n")
    done = harness("explore", path, "--jobs", 1, "--out", out)
    assert done.returncode == 1, done.stderr
    assert "seed 0: characteristic" in done.stdout
    assert "4 agents, " in done.stdout
    assert "nothing more could be left out" in done.stdout
    assert done.stdout.splitlines()[-1].startswith(f"ucp-harness run {out} --backend sim --seed ")


def test_ctrl_c_ends_the_command_with_the_smallest_so_far(tmp_path: Path) -> None:
    path, out = tmp_path / "tie.yaml", tmp_path / "small.yaml"
    path.write_text("name: tie\nagents: 8\nnetwork: {loss: 0.3}\nquirks: {crash_on_tie: true}\n")
    command = [*COMMAND, "explore", str(path), "--jobs", "2", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = iter(process.stdout.readline, "")
        assert any("8 agents" in line or " runs" in line for line in said)
        process.send_signal(signal.SIGINT)
        rest, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130, err
    assert "when it was interrupted: it may not be the smallest" in rest
    assert sentences(err)[-1] == "interrupted"
    assert load_scenario(out).events.source == "scripted"


def test_command_without_a_violation_ends_with_status_0(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text("name: quiet\nagents: 3\nduration_s: 100\n")
    done = harness("explore", path, "--seeds", 3, "--first-seed", 5, "--jobs", 1, "--out", tmp_path / "none.yaml")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "3 seeds played: no characteristic is violated\n"


def test_scenario_that_needs_real_processes_ends_with_status_2(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text("name: real\nvehicles: {kind: ardupilot}\n")
    done = harness("explore", path, "--out", tmp_path / "none.yaml")
    assert done.returncode == 2
    assert "real processes" in sentences(done.stderr)[0]
