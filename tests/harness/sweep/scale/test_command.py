"""`ucp-harness scale` as a user calls it, on the simulation."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.sweep.scale import ScaleRecord, read_request
from tests.harness.command import COMMAND, DEADLINE_S, harness, processes, sentences

SMALL = ("--agents", "3,2,5", "--minutes", "10", "--loss", "0,0.15", "--seeds", 2)


def test_a_sweep_ends_in_a_table_and_files(tmp_path: Path) -> None:
    done = harness("scale", *SMALL, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert not sentences(done.stderr)
    assert "exponent of" in done.stdout
    assert str(tmp_path / "out" / "report.html") in done.stdout
    record = ScaleRecord.model_validate_json((tmp_path / "out" / "scale.json").read_text())
    assert [(cell.loss, cell.agents) for cell in record.cells] == [
        *((0, n) for n in (2, 3, 5)),
        *((0.15, n) for n in (2, 3, 5)),
    ]
    pair = record.cells[0]
    assert pair.estimates["messages_per_block"].mean == 3, "without loss a request, a response and a commit"


def test_json_is_all_that_standard_output_gets_and_it_repeats(tmp_path: Path) -> None:
    runs = [harness("scale", *SMALL, "--json", "--jobs", jobs, "--out", tmp_path / str(jobs)) for jobs in (1, 2)]
    one, two = (ScaleRecord.model_validate_json(done.stdout) for done in runs)
    assert json.loads(runs[0].stdout) == json.loads((tmp_path / "1" / "scale.json").read_text())
    assert one.repeatable() == two.repeatable()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--agents", "5,0"), "--agents is 0: a number of agents is 1..1000"),
        (("--agents", ""), "--agents is empty: a number of agents"),
        (("--agents", "5,,6"), "--agents is empty: a number of agents"),
        (("--agents", "5,2.5"), "--agents is 2.5: a number of agents"),
        (("--agents", "5,5"), "--agents names 5 twice"),
        (("--minutes", "0"), "--minutes is 0: minutes are more than 0 and at most 100000"),
        (("--minutes", "inf"), "--minutes is inf: minutes are"),
        (("--minutes", "nan"), "--minutes is nan: minutes are"),
        (("--loss", "2"), "--loss is 2: a loss is a probability 0..1"),
        (("--seeds", "0"), "--seeds is 0: a number of seeds is 1..1000"),
        (("--settle", "-1"), "--settle is -1: minutes are more than 0"),
    ],
)
def test_a_mistake_is_one_sentence_with_option_value_and_what_is_allowed(
    arguments: tuple[str, str], sentence: str
) -> None:
    asked = {"--agents": "5", "--minutes": "10", "--loss": "0", "--seeds": "1", "--settle": "1", **dict([arguments])}
    with pytest.raises(ScenarioError) as told:
        read_request(
            asked["--agents"], asked["--minutes"], asked["--loss"], int(asked["--seeds"]), float(asked["--settle"])
        )
    assert str(told.value).startswith(sentence)


@pytest.mark.parametrize("arguments", [("--agents", "0"), ("--loss", "2"), ("--minutes", "")])
def test_a_wrong_request_is_status_2(tmp_path: Path, arguments: tuple[str, str]) -> None:
    done = harness("scale", *arguments, "--out", tmp_path / "out")
    assert done.returncode == 2
    (said,) = sentences(done.stderr)
    assert said.startswith(arguments[0])
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    done = harness("scale", *SMALL, "--out", tmp_path)
    assert done.returncode == 2
    assert "is not empty: choose another --out" in sentences(done.stderr)[0]


def test_ctrl_c_keeps_what_is_finished_and_leaves_no_process(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with subprocess.Popen(
        [*COMMAND, "scale", "--agents", "5", "--seeds", "1000", "--json", "--jobs", "2", "--out", str(out)],
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
    assert json.loads((out / "scale.json").read_text()) == json.loads(said)
    assert sentences(complaint)[-1].endswith(f" of 3000 runs that had ended are in {out}")
    assert not processes(tmp_path)
