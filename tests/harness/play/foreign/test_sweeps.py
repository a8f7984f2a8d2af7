"""Test foreign agents (separate programs) in searches and matrices, which play many missions. All programs end
afterwards.
"""

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.errors import HarnessError
from harness.play.simulation.foreign._program_pool import ProgramPool
from harness.run.simulate import simulate
from harness.scenario.verdict_names import ENDED
from harness.sweep.matrix._cell import sum_up
from harness.sweep.matrix._cell_play import RunPlayer
from harness.sweep.matrix._matrix_file import Matrix
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.harness.play.foreign.agents import EXPORT, living, played_by, small

THIRD_EVENT_KILLS = """
count = 0 if 'mission' in given else count + ('event_id' in given)
if count > 2:
    sys.exit('the third event was too much')
"""
BUSY = {"agents": 2, "duration_s": 150, "events": {"source": "random", "mean_s": 15}}


def all_have_ended(word: Path) -> bool:
    deadline = time.monotonic() + DEADLINE_S
    while (left := living(word)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not left


def write_scenario(directory: Path, **keys: Any) -> Path:
    path = directory / "scenario.yaml"
    path.write_text(json.dumps({"name": "foreign", **BUSY, **keys}))
    return path


def test_explore_finds_and_shrinks_a_crash(tmp_path: Path) -> None:
    command = {2: small(tmp_path, EXPORT + THIRD_EVENT_KILLS)}
    events = {"source": "scripted", "script": [{"at_s": at_s, "agent": 1 + at_s % 2} for at_s in range(1, 10)]}
    path = write_scenario(tmp_path, agent_command=command, duration_s=20, events=events)
    done = harness("explore", path, "--seeds", 1, "--jobs", 2, "--out", tmp_path / "shrunk.yaml")
    assert done.returncode == 1
    assert "agent 2: crashed: it ended by itself with status 1 after it received an event at " in done.stdout
    assert "its last output: the third event was too much" in done.stdout
    shrunk = yaml.safe_load((tmp_path / "shrunk.yaml").read_text())
    assert shrunk["agent_command"] == command and len(shrunk["events"]["script"]) == 3
    assert all_have_ended(tmp_path)


def test_explore_names_a_nondeterministic_agent_first(tmp_path: Path) -> None:
    path = write_scenario(tmp_path, agent_command=small(tmp_path, EXPORT + "import time\nsaid['now'] = time.time_ns()"))
    done = harness("explore", path, "--out", tmp_path / "shrunk.yaml")
    assert done.returncode == 1
    (said,) = sentences(done.stderr)
    assert "agent 1 is not deterministic: given its mission at 0 s again, it answers with `now`" in said


def test_matrix_checks_the_first_seed_of_each_cell(tmp_path: Path) -> None:
    command = small(tmp_path, EXPORT + "import time\nsaid['now'] = time.time_ns()")
    document = {"name": "m", "loss": [0.0, 0.1], "seeds": 2, "scenario": {**BUSY, "agent_command": command}}
    matrix = Matrix.model_validate({**document, "backend": ["sim"]})
    player = RunPlayer(matrix, tmp_path)
    first, *_ = matrix.tasks
    with pytest.raises(HarnessError, match="is not deterministic"):
        player(first)


def test_dead_program_is_a_violation_in_a_matrix(tmp_path: Path) -> None:
    command = {2: small(tmp_path, EXPORT + THIRD_EVENT_KILLS)}
    document = {"name": "m", "loss": [0.0], "seeds": 1, "scenario": {**BUSY, "agent_command": command}}
    matrix = Matrix.model_validate({**document, "backend": ["sim"]})
    (task,) = matrix.tasks
    cell = sum_up(task.point, [RunPlayer(matrix, tmp_path)(task)])
    assert (cell.failed, cell.violated[ENDED]) == (0, [task.seed])


def test_pool_reuses_programs_and_ends_them(tmp_path: Path) -> None:
    one = played_by(small(tmp_path, EXPORT), agents=3, duration_s=10, events={"source": "scripted", "script": []})
    programs = ProgramPool()
    taken = [programs.take(small(tmp_path, EXPORT), agent) for agent in (1, 2)]
    taken[0].owes_an_answer = True
    for program in taken:
        programs.give_back(program)
    assert len(living(tmp_path)) == 1
    programs.close()
    assert all_have_ended(tmp_path)
    simulate(one, 1)
    assert len(living(tmp_path)) == 3  # idle programs for the next mission of this process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_program_remains_after_the_end_of_a_sweep(tmp_path: Path, number: signal.Signals) -> None:
    path = write_scenario(tmp_path, agent_command=small(tmp_path, EXPORT), duration_s=2000)
    command = [*COMMAND, "explore", str(path), "--seeds", "100000", "--jobs", "2", "--out", str(tmp_path / "s.yaml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + DEADLINE_S
        while not living(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert living(tmp_path)
        process.send_signal(number)
        process.communicate(timeout=DEADLINE_S)
    assert all_have_ended(tmp_path)
