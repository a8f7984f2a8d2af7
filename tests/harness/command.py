"""Run `ucp-harness` like a user, and list the processes that it started."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.harness import forks

DEADLINE_S = 300.0
COMMAND = [sys.executable, "-m", "harness.cli"]


def harness(
    *arguments: object,
    deadline_s: float = DEADLINE_S,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    input: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, and return its output.

    By default, remove the variable COLUMNS, which a worker of pytest-xdist sets, because output in a pipe has no width.
    """
    if env is None:
        env = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    words = [str(argument) for argument in arguments]
    if forks.same_interpreter(env):
        return forks.call(words, env, cwd or Path.cwd(), input, deadline_s)
    return subprocess.run(
        [*COMMAND, *words], capture_output=True, text=True, timeout=deadline_s, env=env, cwd=cwd, input=input
    )


def sentences(stderr: str) -> list[str]:
    """Return the lines of standard error without their prefix. Fail if they contain a traceback."""
    assert "Traceback" not in stderr, stderr
    return [line.removeprefix("ucp-harness: ") for line in stderr.splitlines()]


def write_scenario(directory: Path, **keys: Any) -> Path:
    """Write a scenario with a short mission. By default, the mission takes two seconds of wall time."""
    scenario = {"name": "test", "agents": 3, "duration_s": 200, "speedup": 100, **keys}
    path = directory / "scenario.yaml"
    path.write_text(json.dumps(scenario))  # JSON is YAML
    return path


class Running:
    """An active run that a test can observe and disturb."""

    def __init__(
        self, scenario: Path, out: Path, *options: object, command: Sequence[str] = COMMAND, **settings: Any
    ) -> None:
        self.out = out
        self.process = subprocess.Popen(
            [*command, "run", str(scenario), "--out", str(out), *map(str, options)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **settings,
        )

    def wait_for(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert self.process.poll() is None, f"it ended before {what}: {self.process.communicate()}"
            assert time.monotonic() < deadline, f"never: {what}"
            time.sleep(0.02)

    def wait_for_mission(self, *agents: int) -> None:
        """Wait until each of these agents has written a handler run into its trace."""

        def traced() -> bool:
            paths = [self.out / "agents" / f"{agent}.trace.jsonl" for agent in agents]
            return all(path.exists() and path.read_text().count("\n") > 1 for path in paths)

        self.wait_for(traced, "the mission")

    def signal_agent(self, agent: int, number: signal.Signals) -> None:
        (pid,) = [pid for pid, command in processes(self.out).items() if f"{agent}.mission.json" in command]
        os.kill(pid, number)

    def end(self) -> tuple[int, str, str]:
        """Wait until the run ends. Return its exit status, standard output and standard error."""
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, err

    def record(self) -> dict[str, Any]:
        record: dict[str, Any] = json.loads((self.out / "run.json").read_text())
        return record


def processes(directory: Path) -> dict[int, str]:
    """Return the command line of every process whose command names this run directory, by process ID."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            working = str((entry / "cwd").readlink())
        except OSError:
            continue
        if str(directory) in command or working.startswith(str(directory)):
            found[int(entry.name)] = command
    return found
