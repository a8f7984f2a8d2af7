"""Play runs in virtual time and write their records, which tests read."""

from pathlib import Path
from typing import Any

from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.virtual import scenario


def flown(directory: Path, seed: int = 1, **keys: Any) -> Path:
    """Play a run of a few minutes and write its directory. `keys` are additional keys of the scenario."""
    mission = {"agents": 3, "duration_s": 400, "network": {"loss": 0.2}, **keys}
    return run(scenario(**mission), seed, directory, SilentProgress(), "sim").directory


def trace_of(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.trace.jsonl"
