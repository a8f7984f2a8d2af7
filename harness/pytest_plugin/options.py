"""What the command line of pytest says about runs; it has the last word over tests and scenarios."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.load import parse


@dataclass(frozen=True)
class Options:
    """None where the command line says nothing."""

    backend: BackendName | None
    seed: int | None
    speedup: float | None
    keep: Path | None
    """Where all run directories are kept, absolute."""
    rewrite: bool
    """Whether stories are written anew, not compared."""

    @classmethod
    def of(cls, config: pytest.Config) -> "Options":
        """Raises ScenarioError."""
        backend, seed, speedup, keep = (
            config.getoption(f"--ucp-{name}") for name in ("backend", "seed", "speedup", "keep")
        )
        if seed is not None and seed < 0:
            raise ScenarioError(f"--ucp-seed is {seed}: it should be 0 or more")
        return cls(
            backend, seed, speedup, keep and config.invocation_params.dir / keep, config.getoption("--ucp-rewrite")
        )

    def at_speedup(self, scenario: Scenario) -> Scenario:
        """Raises ScenarioError."""
        return scenario if self.speedup is None else parse({**scenario.model_dump(), "speedup": self.speedup})
