"""`python -m tests.fuzz [TARGET ...] [--seconds 60] [--random] [--inputs N]`: give hostile input to all readers.

`--seconds` is the time for each target. `--inputs` limits the number of inputs for each target instead. If `atheris` is
installed (`pip install -e '.[test,fuzz]'`), coverage guides the mutations. Without it, or with `--random`, the stored
inputs are mutated at random. New inputs that cover more code are stored in .fuzz for the next call. Failing inputs are
stored in .fuzz/failures, and the exit status is then 1. Readers get their inputs as files in memory, because a disk
would take most of the time.
"""

import argparse
import hashlib
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.corpus import FOLDER, files_of
from tests.fuzz.execute import executed, mutated
from tests.fuzz.finding import MOST_WALL_S
from tests.fuzz.targets import NAMES, named

GROWN = Path(".fuzz")
FAILURES = GROWN / "failures"
MOST_BYTES = 65536
MOST_MIB = 1024
MEMORY = Path("/dev/shm")  # noqa: S108
PATIENCE_S = 900
"""Additional seconds for a target on a busy machine, for its start and its last input."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(NAMES)}; all if none is named")
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    parser.add_argument("--random", action="store_true", help="no coverage guidance")
    parser.add_argument("--inputs", type=int, help="for each target, in place of a time")
    asked = parser.parse_args()
    if unknown := [name for name in asked.targets if name not in NAMES]:
        parser.error(f"there is no target {unknown[0]}: there are {', '.join(NAMES)}")
    FAILURES.mkdir(parents=True, exist_ok=True)
    is_guided = not asked.random and find_spec("atheris") is not None
    fuzzed = _guided if is_guided else _at_random
    with TemporaryDirectory(prefix="ucp-fuzz-", dir=MEMORY if os.access(MEMORY, os.W_OK) else None) as scratch:
        tempfile.tempdir = scratch
        failed = [name for name in asked.targets or NAMES if not fuzzed(name, asked.seconds, asked.inputs)]
    if failed:
        sys.stdout.write(f"failed: {', '.join(failed)}; the inputs are in {FAILURES}\n")
    return 1 if failed else 0


def _guided(name: str, seconds: int, limit: int | None) -> bool:
    """Fuzz a target with coverage guidance for some seconds, or with `limit` inputs. Return false if an input fails.

    The target runs in a new process, because libFuzzer ends its process.
    """
    grown = GROWN / name
    grown.mkdir(exist_ok=True)
    log = GROWN / f"{name}.log"
    options = [
        f"-max_total_time={seconds}" if limit is None else f"-runs={limit}",
        f"-timeout={MOST_WALL_S:.0f}",
        f"-rss_limit_mb={MOST_MIB}",
    ]
    options += [f"-max_len={MOST_BYTES}", "-print_final_stats=1", f"-artifact_prefix={FAILURES}/{name}-"]
    with TemporaryDirectory(prefix="ucp-fuzz-") as scratch, log.open("wb") as output:
        command = [sys.executable, "-m", "tests.fuzz.guided", name, *options, str(grown), str(FOLDER / name)]
        began = time.monotonic()
        running = subprocess.Popen(["env", f"TMPDIR={scratch}", *command], stdout=output, stderr=output)
        try:
            status = running.wait(seconds + PATIENCE_S if limit is None else None)
            problem = f"ended with status {status}" if status else ""
        except subprocess.TimeoutExpired:
            problem = "hangs"
            _where_it_hangs(running)
        left = [path.name for path in Path(scratch).iterdir() if not path.name.startswith("fuzz-")]
    if left and not problem:
        problem = f"leaves {left[0]} behind"
    log_text = log.read_text(errors="replace")
    inputs = int((re.findall(r"stat::number_of_executed_units: (\d+)", log_text) or ["0"])[-1])
    edges = (re.findall(r"cov: (\d+)", log_text) or ["0"])[-1]
    _tell(name, inputs, time.monotonic() - began, f"{edges} edges", f"{problem}, see {log}" if problem else "")
    return not problem


def _where_it_hangs(running: "subprocess.Popen[bytes]") -> None:
    """Let a hanging process write its stack to its log. Store its input as a failure, and kill the process."""
    for number in (signal.SIGUSR1, signal.SIGABRT):
        running.send_signal(number)
        time.sleep(1)
    running.kill()
    running.wait()


def _at_random(name: str, seconds: int, limit: int | None) -> bool:
    """Fuzz a target with random mutations for some seconds, or with `limit` inputs. Return false if an input fails."""
    target, kept = named(name), [path.read_bytes() for path in files_of(name)]
    began, inputs, problem = time.monotonic(), 0, ""
    for data in mutated(kept, seed=time.time_ns()):
        if problem or (time.monotonic() > began + seconds if limit is None else inputs == limit):
            break
        inputs += 1
        try:
            executed(target, data)
        except Exception:
            failed = FAILURES / f"{name}-crash-{hashlib.sha1(data, usedforsecurity=False).hexdigest()}"
            failed.write_bytes(data)
            problem = f"{failed}: {traceback.format_exc()}"
    largest_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    _tell(name, inputs, time.monotonic() - began, f"at random, at most {largest_mib} MiB", problem)
    return not problem


def _tell(name: str, inputs: int, seconds: float, reached: str, problem: str) -> None:
    rate = inputs / seconds if seconds else 0.0
    sys.stdout.write(f"{name:11} {inputs:8} inputs, {rate:6.0f}/s, {reached}, {problem or 'nothing fails'}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
