"""Runs in virtual time, left on disk as any run is, whose records are then played again."""

from pathlib import Path
from typing import Any

from harness.play.progress import Silent
from harness.run.run import run
from tests.harness.virtual import scenario


def flown(directory: Path, seed: int = 1, **keys: Any) -> Path:
    """The directory of a run of some minutes; `keys` are the scenario's."""
    mission = {"agents": 3, "duration_s": 400, "network": {"loss": 0.2}, **keys}
    return run(scenario(**mission), seed, directory, Silent(), "sim").directory


def trace_of(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.trace.jsonl"
