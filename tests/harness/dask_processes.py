"""Start the scheduler and the workers of a Dask cluster as local processes."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.harness.command import DEADLINE_S


class Cluster:
    """The processes of Dask. Their output is in `directory`."""

    def __init__(self, directory: Path, stack: contextlib.ExitStack) -> None:
        self._directory, self._stack = directory, stack
        self._file = directory / "scheduler.json"

    def start_scheduler(self, **env: str) -> str:
        """Start the scheduler and return its address. The scheduler waits two seconds for a lost worker instead of
        30.
        """
        env["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "2s"
        self.scheduler = self._start("scheduler", "scheduler", "--port", "0", "--scheduler-file", self._file, **env)
        until(lambda: self._file.exists() and self._file.stat().st_size > 0)
        address: str = json.loads(self._file.read_text())["address"]
        return address

    def start_worker(self, address: str, name: str, threads: int = 1, **env: str) -> "subprocess.Popen[str]":
        options = ("--nthreads", threads, "--no-nanny", "--local-directory", self._directory / name)
        worker = self._start(name, "worker", address, *options, **env)
        until(lambda: "Registered to" in (self._directory / f"{name}.log").read_text())
        return worker

    def _start(self, name: str, what: str, *options: object, **env: str) -> "subprocess.Popen[str]":
        log = self._stack.enter_context((self._directory / f"{name}.log").open("w"))
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1", "--no-dashboard"]
        process = subprocess.Popen(
            [*command, *map(str, options)], stdout=log, stderr=log, text=True, env={**os.environ, **env}
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
