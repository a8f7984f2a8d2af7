"""Agents of other makes over many missions: explored and shrunk, in a matrix, and nobody left behind."""

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.errors import HarnessError
from harness.play.simulation.foreign._virtual_program import Programs
from harness.run.simulate import simulate
from harness.sweep.matrix._cell_play import Player
from harness.sweep.matrix._matrix_file import Matrix
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.play.foreign.agents import EXPORT, living, played_by, small

THIRD_EVENT_KILLS = """
count = 0 if 'mission' in given else count + ('event_id' in given)
if count > 2:
    sys.exit('the third event was too much')
"""
BUSY = {"agents": 2, "duration_s": 150, "events": {"source": "random", "mean_s": 15}}


def nobody_is_left(word: Path) -> bool:
    deadline = time.monotonic() + DEADLINE_S
    while (left := living(word)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not left


def written(directory: Path, **keys: Any) -> Path:
    path = directory / "asked.yaml"
    path.write_text(json.dumps({"name": "asked", **BUSY, **keys}))
    return path


def test_a_crash_is_found_and_shrunk_to_what_it_takes(tmp_path: Path) -> None:
    command = {2: small(tmp_path, EXPORT + THIRD_EVENT_KILLS)}
    events = {"source": "scripted", "script": [{"at_s": at_s, "agent": 1 + at_s % 2} for at_s in range(1, 10)]}
    asked = written(tmp_path, agent_command=command, duration_s=20, events=events)
    done = harness("explore", asked, "--seeds", 1, "--jobs", 2, "--out", tmp_path / "shrunk.yaml", deadline_s=240)
    assert done.returncode == 1
    assert "agent 2: crashed: it ended by itself with status 1 when it was given an event at " in done.stdout
    assert "its last output: the third event was too much" in done.stdout
    shrunk = yaml.safe_load((tmp_path / "shrunk.yaml").read_text())
    assert shrunk["agent_command"] == command and len(shrunk["events"]["script"]) == 3
    assert nobody_is_left(tmp_path)


def test_an_agent_that_is_not_the_same_twice_is_named_before_its_seeds_are_played(tmp_path: Path) -> None:
    asked = written(tmp_path, agent_command=small(tmp_path, EXPORT + "import time\nsaid['now'] = time.time_ns()"))
    done = harness("explore", asked, "--out", tmp_path / "shrunk.yaml")
    assert done.returncode == 1
    (said,) = sentences(done.stderr)
    assert "agent 1 is not deterministic: given its mission at 0 s again, it answers with `now`" in said


def test_a_matrix_looks_at_the_first_seed_of_each_cell(tmp_path: Path) -> None:
    command = small(tmp_path, EXPORT + "import time\nsaid['now'] = time.time_ns()")
    asked = {"name": "m", "loss": [0.0, 0.1], "seeds": 2, "scenario": {**BUSY, "agent_command": command}}
    matrix = Matrix.model_validate({**asked, "backend": ["sim"]})
    player = Player(matrix, tmp_path)
    first, *_ = matrix.tasks
    with pytest.raises(HarnessError, match="is not deterministic"):
        player(first)


def test_programs_that_wait_are_few_and_die_with_who_started_them(tmp_path: Path) -> None:
    one = played_by(small(tmp_path, EXPORT), agents=3, duration_s=10, events={"source": "scripted", "script": []})
    programs = Programs()
    taken = [programs.take(small(tmp_path, EXPORT), agent) for agent in (1, 2)]
    taken[0].owes_an_answer = True
    for program in taken:
        programs.give_back(program)
    assert len(living(tmp_path)) == 1
    programs.close()
    assert nobody_is_left(tmp_path)
    simulate(one, 1)
    assert len(living(tmp_path)) == 3  # they wait for the next mission of this process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nobody_is_left_when_a_sweep_is_ended(tmp_path: Path, number: signal.Signals) -> None:
    asked = written(tmp_path, agent_command=small(tmp_path, EXPORT), duration_s=2000)
    command = [*COMMAND, "explore", str(asked), "--seeds", "100000", "--jobs", "2", "--out", str(tmp_path / "s.yaml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + DEADLINE_S
        while not living(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert living(tmp_path)
        process.send_signal(number)
        process.communicate(timeout=DEADLINE_S)
    assert nobody_is_left(tmp_path)
