"""Test the command `ucp-harness matrix` with simulated runs."""

import csv
import json
import shlex
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from harness.sweep.matrix import MatrixRecord
from tests.harness.command import COMMAND, DEADLINE_S, harness, processes, sentences
from tests.harness.unsupported import refusing_to_start


def written(directory: Path, **keys: Any) -> Path:
    """Play a small matrix with two loss rates and three seeds. Each run takes ten minutes."""
    scenario = {"agents": 4, "duration_s": 600, "events": {"source": "random"}}
    path = directory / "matrix.yaml"
    path.write_text(json.dumps({"name": "small", "scenario": scenario, "loss": [0.0, 1.0], "seeds": 3, **keys}))
    return path


def test_matrix_ends_with_a_table_and_files(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--backend", "sim", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not sentences(done.stderr)
    assert "Means of 3 runs per cell, with 95" in done.stdout
    assert "Not applicable" not in done.stdout, "every step is judged, too"
    assert str(tmp_path / "out" / "report.html") in done.stdout
    files = {path.name for path in (tmp_path / "out").iterdir()}
    figures = {"results.jsonl", "matrix.json", "matrix.csv", "runs.csv"}
    assert files == {*figures, "matrix.svg", "report.html", "summary.md", "junit.xml", "cells"}


def test_matrix_finds_one_chain_at_loss_0_and_no_mutual_chain_at_loss_1(tmp_path: Path) -> None:
    harness("matrix", written(tmp_path), "--out", tmp_path / "out")
    with (tmp_path / "out" / "matrix.csv").open() as file:
        perfect, alone = csv.DictReader(file)
    assert (float(perfect["uniform"]), float(perfect["mutual_share"]), float(perfect["reconciles"])) == (1, 1, 0)
    assert (float(alone["uniform"]), float(alone["mutual_share"]), float(alone["copies_mean"])) == (0, 0, 1)


def test_matrix_names_the_handlers_of_the_first_deviations(tmp_path: Path) -> None:
    often = {"source": "random", "mean_s": 5}
    wrong = {"agents": 3, "duration_s": 200, "quirks": {"approve_everything": True}, "events": often}
    asked = written(tmp_path, scenario=wrong, loss=[0.3], seeds=2)
    done = harness("matrix", asked, "--backend", "sim", "--out", tmp_path / "out")
    assert done.returncode == 1, done.stdout + done.stderr
    first = "steps deviate in 2 of 2 runs, seeds 1, 2; first in receive_request_add_block (2)"
    assert first in " ".join(done.stdout.split())


def test_matrix_with_three_sizes_prints_and_draws_growth(tmp_path: Path) -> None:
    scenario = {"duration_s": 600, "events": {"source": "random"}}
    asked = written(tmp_path, scenario=scenario, agents=[3, 2, 5], seeds=2, loss=[0, 0.15])
    done = harness("matrix", asked, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "exponent of" in done.stdout
    assert (tmp_path / "out" / "growth.svg").exists()
    record = MatrixRecord.model_validate_json((tmp_path / "out" / "matrix.json").read_text())
    assert [(cell.loss, cell.agents) for cell in record.cells] == [(loss, n) for n in (3, 2, 5) for loss in (0, 0.15)]
    pair = next(cell for cell in record.cells if (cell.loss, cell.agents) == (0, 2))
    assert pair.estimates["messages_per_block"].mean == 3, "a request, a response and a commit"


def test_standard_output_contains_only_json(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--json", "--jobs", 2, "--out", tmp_path / "out")
    assert done.returncode == 0
    assert json.loads(done.stdout) == json.loads((tmp_path / "out" / "matrix.json").read_text())
    assert [cell.runs for cell in MatrixRecord.model_validate_json(done.stdout).cells] == [3, 3]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"loss": [2]}, "`loss.0` is 2: it should be less than or equal to 1"),
        ({"scenario": {"agent_command": ["./agent"]}}, "`agent_command`: ./agent is not a program"),
    ],
)
def test_wrong_request_causes_one_sentence_and_status_2(tmp_path: Path, keys: dict[str, Any], sentence: str) -> None:
    done = harness("matrix", written(tmp_path, **keys), "--out", tmp_path / "out")
    assert done.returncode == 2
    (said,) = sentences(done.stderr)
    assert sentence in said


def test_continued_matrix_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    asked = written(tmp_path, seeds=80)
    command = [*COMMAND, "matrix", str(asked), "--jobs", "2", "--out", str(tmp_path / "out")]
    results = tmp_path / "out" / "results.jsonl"
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not results.exists() or results.read_bytes().count(b"\n") < 10:
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        process.kill()
        process.communicate()
    ended = results.read_bytes()
    ended = ended[: ended.rfind(b"\n") + 1]
    assert ended.count(b"\n") < 161
    done = harness("matrix", asked, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert results.read_bytes().startswith(ended)
    assert results.read_bytes().count(b"\n") == 161
    harness("matrix", asked, "--out", tmp_path / "whole")
    for name in ("matrix.csv", "runs.csv", "matrix.svg"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_against_compares_with_an_earlier_night(tmp_path: Path) -> None:
    asked = written(tmp_path)
    harness("matrix", asked, "--out", tmp_path / "before")
    baseline = tmp_path / "before" / "matrix.json"
    same = harness("matrix", asked, "--against", baseline, "--out", tmp_path / "same")
    assert (same.returncode, sentences(same.stderr)) == (0, [])
    record = json.loads(baseline.read_text())
    for run in record["results"]:
        run["figures"]["copies_mean"] += run["loss"] == 1.0
    record["cells"][1]["estimates"]["copies_mean"] = {"n": 3, "mean": 2.0, "low": 1.9, "high": 2.1}
    baseline.write_text(json.dumps(record))
    worse = harness("matrix", asked, "--against", baseline, "--out", tmp_path / "worse")
    assert worse.returncode == 1
    assert "100 % loss: copies mean worse: 1, was 2; -50 % in 3 pairs (-50 to -50)" in worse.stdout.replace(
        "\u00a0", " "
    )
    other = harness("matrix", written(tmp_path, loss=[0.5]), "--against", baseline, "--out", tmp_path / "other")
    assert other.returncode == 0
    assert "the baseline lacks some cells, which are not compared" in other.stdout


@pytest.mark.lab
@pytest.mark.parametrize("keep", ["violated", "all"])
@pytest.mark.any_user
def test_matrix_of_processes_keeps_the_requested_run_directories(tmp_path: Path, keep: str) -> None:
    scenario = {"agents": 2, "duration_s": 60, "speedup": 60, "vehicles": {"kind": "none"}}
    asked = written(tmp_path, scenario=scenario, loss=[0.0], seeds=2, backend="process", keep=keep)
    done = harness("matrix", asked, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    (cell,) = MatrixRecord.model_validate_json((tmp_path / "out" / "matrix.json").read_text()).cells
    assert (cell.backend, cell.runs, cell.failed) == ("process", 2, 0)
    assert cell.verdicts["3"] == {"holds": 2}
    kept = sorted(path.parent.name for path in tmp_path.glob("out/runs/*/run.json"))
    assert kept == (["loss-0.0-agents-2-process-seed-1", "loss-0.0-agents-2-process-seed-2"] if keep == "all" else [])


@pytest.mark.lab
@pytest.mark.any_user
def test_run_with_a_crashed_agent_is_a_result_and_is_kept(tmp_path: Path) -> None:
    agent = tmp_path / "agent"
    agent.write_text("#!/bin/sh\nexit 7\n")
    agent.chmod(0o755)
    scenario = {"agents": 2, "duration_s": 60, "vehicles": {"kind": "none"}, "agent_command": [str(agent)]}
    asked = written(tmp_path, scenario=scenario, loss=[0.0, 0.5], seeds=1, backend="process")
    done = harness("matrix", asked, "--out", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    failed = MatrixRecord.model_validate_json((tmp_path / "out" / "matrix.json").read_text()).failed
    assert [run.loss for run in failed] == [0.0, 0.5]
    for run in failed:
        kept = tmp_path / "out" / "runs" / f"loss-{run.loss}-agents-2-process-seed-1"
        assert run.reason.endswith(f"; see {kept}")
        assert (kept / "run.json").exists()


@pytest.mark.lab
@pytest.mark.any_user
def test_unsupported_run_is_neither_failed_nor_violated(tmp_path: Path) -> None:
    agent = refusing_to_start(tmp_path / "agent")
    scenario = {"agents": 2, "duration_s": 60, "vehicles": {"kind": "none"}, "agent_command": {1: [str(agent)]}}
    asked = written(tmp_path, scenario=scenario, loss=[0.0], seeds=1, backend="process")
    done = harness("matrix", asked, "--out", tmp_path / "out")
    assert done.returncode == 3, done.stderr
    record = MatrixRecord.model_validate_json((tmp_path / "out" / "matrix.json").read_text())
    (run,) = record.unsupported
    assert run.reason == f"not supported by agent 1 ({shlex.quote(str(agent))}): mine has no telemetry"
    assert "mine has no telemetry" in " ".join(done.stdout.split())
    assert (record.failed, record.cells[0].violated, record.cells[0].unsupported) == ([], {}, 1)
    assert "<skipped message=" in (tmp_path / "out" / "junit.xml").read_text()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "1 not supported" in page and f"agent 1 ran {agent}" in page


def test_unplayable_backend_is_refused_before_the_first_run(tmp_path: Path) -> None:
    scenario = {"agents": 2, "clocks": {"1": {"drift": 0.1}}}
    done = harness(
        "matrix", written(tmp_path, scenario=scenario, backend=["sim", "process"]), "--out", tmp_path / "out"
    )
    assert done.returncode == 2
    assert sentences(done.stderr) == ["`clocks` needs virtual time: use --backend sim"]
    assert not (tmp_path / "out").exists()


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--out", tmp_path)
    assert done.returncode == 2
    assert "is not empty: choose another --out" in sentences(done.stderr)[0]


def test_ctrl_c_keeps_finished_runs_and_leaves_no_process(tmp_path: Path) -> None:
    matrix = written(tmp_path, seeds=10_000)
    out = tmp_path / "out"
    with subprocess.Popen(
        [*COMMAND, "matrix", str(matrix), "--json", "--jobs", "2", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        while len(processes(tmp_path)) < 3:  # two workers have been forked
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130
    assert json.loads(said)["outcome"] == "interrupted"
    assert json.loads((out / "matrix.json").read_text()) == json.loads(said)
    way_on, sentence = sentences(complaint)
    assert way_on == f"to continue, repeat the command with --out {out}"
    assert sentence.startswith("interrupted; results of ")
    assert sentence.endswith(f" of 20000 runs are in {out}")
    assert not processes(tmp_path)
