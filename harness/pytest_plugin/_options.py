"""What the command line of pytest says about runs; it has the last word over tests and scenarios."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.agent_programs import Programs, command_keys, programs_of
from harness.scenario.load import parse


@dataclass(frozen=True)
class Options:
    """None where the command line says nothing."""

    backend: BackendName | None
    seed: int | None
    speedup: float | None
    keep: Path | None
    """Where all run directories are kept, absolute."""
    in_uml: bool
    """Whether processes are to be played in User Mode Linux."""
    image_from_host: bool
    """Whether containers are made of this machine's own files."""
    programs: Programs
    rewrite: bool
    """Whether stories are written anew, not compared."""

    @classmethod
    def of(cls, config: pytest.Config) -> "Options":
        """Raises ScenarioError."""
        backend, seed, speedup, keep = (
            config.getoption(f"--ucp-{name}") for name in ("backend", "seed", "speedup", "keep")
        )
        if seed is not None and seed < 0:
            raise ScenarioError(f"--ucp-seed is {seed}: use a number from 0 on")
        return cls(
            backend,
            seed,
            speedup,
            keep and config.invocation_params.dir / keep,
            config.getoption("--ucp-kernel") == "uml",
            config.getoption("--ucp-image-from-host"),
            programs_of(config.getoption("--ucp-agent") or []),
            config.getoption("--ucp-rewrite"),
        )

    def laid_over(self, scenario: Scenario) -> Scenario:
        """The scenario as it is to be played. Raises ScenarioError."""
        document = scenario.model_dump()
        if self.speedup is not None:
            document["speedup"] = self.speedup
        document |= command_keys(scenario, self.programs)
        if self.image_from_host:
            document["docker"]["image_from_host"] = True
        return parse(document) if document != scenario.model_dump() else scenario

    def refuse(self, backend: BackendName) -> None:
        """Raises MachineError, with the reason, for a backend that cannot play where the command line wants it to."""
        if self.in_uml:
            from harness.pytest_plugin._kernel_option import refuse_outside

            refuse_outside(backend)
