"""`ucp-harness matrix` as a user calls it, on the simulation."""

import csv
import json
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from harness.matrix import MatrixRecord
from tests.harness.command import COMMAND, DEADLINE_S, harness, processes, sentences


def written(directory: Path, **keys: Any) -> Path:
    """A small matrix: two rates, three seeds, ten minutes."""
    scenario = {"agents": 4, "duration_s": 600, "events": {"source": "random"}}
    path = directory / "matrix.yaml"
    path.write_text(json.dumps({"name": "small", "scenario": scenario, "loss": [0.0, 1.0], "seeds": 3, **keys}))
    return path


def test_a_matrix_ends_in_a_table_and_files(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--backend", "sim", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not sentences(done.stderr)
    assert "Means of 3 runs a cell" in done.stdout
    assert "Not applicable in any run: characteristic 1." in " ".join(done.stdout.split())
    assert str(tmp_path / "out" / "matrix.svg") in done.stdout
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"matrix.json", "matrix.csv", "runs.csv", "matrix.svg"}


def test_it_finds_one_chain_without_loss_and_none_in_common_without_contact(tmp_path: Path) -> None:
    harness("matrix", written(tmp_path), "--out", tmp_path / "out")
    with (tmp_path / "out" / "matrix.csv").open() as file:
        perfect, alone = csv.DictReader(file)
    assert (float(perfect["uniform"]), float(perfect["mutual_share"]), float(perfect["reconciles"])) == (1, 1, 0)
    assert (float(alone["uniform"]), float(alone["mutual_share"]), float(alone["copies_mean"])) == (0, 0, 1)


def test_json_is_all_that_standard_output_gets(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--json", "--jobs", 2, "--out", tmp_path / "out")
    assert done.returncode == 0
    assert json.loads(done.stdout) == json.loads((tmp_path / "out" / "matrix.json").read_text())
    assert [cell.runs for cell in MatrixRecord.model_validate_json(done.stdout).cells] == [3, 3]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"loss": [2]}, "`loss.0` is 2: it should be less than or equal to 1"),
        ({"scenario": {"agent_command": ["./agent"]}}, "`agent_command` needs real processes"),
    ],
)
def test_a_wrong_request_is_one_sentence_and_status_2(tmp_path: Path, keys: dict[str, Any], sentence: str) -> None:
    done = harness("matrix", written(tmp_path, **keys), "--out", tmp_path / "out")
    assert done.returncode == 2
    (said,) = sentences(done.stderr)
    assert sentence in said


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    done = harness("matrix", written(tmp_path), "--out", tmp_path)
    assert done.returncode == 2
    assert "is not empty: choose another --out" in sentences(done.stderr)[0]


def test_ctrl_c_keeps_what_is_finished_and_leaves_no_process(tmp_path: Path) -> None:
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
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130
    assert json.loads(said)["outcome"] == "interrupted"
    assert json.loads((out / "matrix.json").read_text()) == json.loads(said)
    (sentence,) = sentences(complaint)
    assert sentence.startswith("interrupted; the ")
    assert sentence.endswith(f" of 20000 runs that had ended are in {out}")
    assert not processes(tmp_path)
