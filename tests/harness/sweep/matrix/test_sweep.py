"""Test how tasks are distributed over all processor cores: their order, their failures, and the end of all
processes.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from harness.errors import MachineError
from harness.run.parallel import FailedTask, sweep
from tests.harness.command import DEADLINE_S

INTERRUPTED = r"""
import os, sys, time
from pathlib import Path
from harness.run.parallel import sweep

def work(n):
    if n == 0:
        return n
    os.write(1, b"%d\n" % os.getpid())  # two processes write whole lines
    time.sleep(60)

try:
    with sweep(range(10), work, 2) as outcomes:
        for _ in outcomes:
            pass
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rsplit(")")[-1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_outcomes_come_in_the_order_of_the_tasks(jobs: int) -> None:
    def work(number: int) -> int:
        time.sleep(0.002 * (number % 3))  # later tasks end before earlier ones
        return number * number

    with sweep(range(40), work, jobs) as outcomes:
        assert list(outcomes) == [(number, number * number) for number in range(40)]


def test_outcomes_may_come_in_order_of_completion() -> None:
    with sweep([0.5, 0.0, 0.01], time.sleep, 2, in_order=False) as outcomes:
        assert [task for task, _ in outcomes] == [0.0, 0.01, 0.5]


@pytest.mark.parametrize("jobs", [1, 2])
def test_failed_task_gives_its_reason_and_others_continue(jobs: int) -> None:
    def work(number: int) -> float:
        return 1 / number

    with sweep([1, 0, 2], work, jobs) as outcomes:
        (_, first), (_, failed), (_, last) = outcomes
    assert (first, last) == (1.0, 0.5)
    assert isinstance(failed, FailedTask)
    assert failed.reason.startswith("ZeroDivisionError: division by zero (test_sweep.py line ")


def test_killed_process_fails_one_task() -> None:
    def work(number: int) -> int:
        if number in (3, 4, 9):
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    with sweep(range(10), work, 2) as outcomes:
        results = dict(outcomes)
    failed = {number: one.reason for number, one in results.items() if isinstance(one, FailedTask)}
    assert set(failed) == {3, 4, 9}
    assert "killed by SIGKILL" in failed[3]
    assert [results[number] for number in (0, 1, 2, 5, 6, 7, 8)] == [0, 1, 2, 5, 6, 7, 8]


@pytest.mark.parametrize("jobs", [1, 2])
def test_error_of_the_whole_request_is_raised(jobs: int) -> None:
    def work(number: int) -> int:
        raise MachineError("there is no air here")

    with pytest.raises(MachineError, match="no air"), sweep(range(10), work, jobs) as outcomes:
        list(outcomes)


@pytest.mark.parametrize("jobs", [1, 2])
def test_leaving_endless_tasks_leaves_no_process(jobs: int) -> None:
    def work(number: int) -> int:
        return os.getpid()

    with sweep(iter(int, 1), work, jobs) as outcomes:
        pids = {pid for _, (_, pid) in zip(range(20), outcomes, strict=False) if isinstance(pid, int)}
    assert pids
    assert not any(alive(pid) for pid in pids - {os.getpid()})


def test_no_tasks_have_no_outcomes() -> None:
    with sweep([], str, 2) as outcomes:
        assert list(outcomes) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_ends_all_processes_at_once(number: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pids = [int(process.stdout.readline()) for _ in range(2)]
        process.send_signal(number)
        said, _ = process.communicate(timeout=DEADLINE_S)
    assert said == "interrupted\n"
    assert not any(alive(pid) for pid in pids)


def test_ctrl_c_in_a_terminal_signals_only_the_starting_process() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        pids = [int(process.stdout.readline()) for _ in range(2)]
        assert process.pid not in {os.getpgid(pid) for pid in pids}, "a terminal signals a whole process group"
        os.killpg(process.pid, signal.SIGINT)
        said, _ = process.communicate(timeout=DEADLINE_S)
    assert said == "interrupted\n"


def test_processes_die_with_the_process_that_started_them() -> None:
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pids = [int(process.stdout.readline()) for _ in range(2)]
        process.kill()
        process.communicate(timeout=DEADLINE_S)
    deadline = time.monotonic() + DEADLINE_S
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.01)
