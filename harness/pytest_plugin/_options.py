"""Define pytest's command-line options for runs. These options replace the values in tests and scenarios."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.scenario import Scenario
from harness.scenario.agent_programs import Programs, command_keys, programs_of
from harness.scenario.load import parse


@dataclass(frozen=True)
class SessionOptions:
    """The options of a pytest session. An option is None if the user does not give it."""

    backend: BackendName | None
    seed: int | None
    speedup: float | None
    keep: Path | None
    """Absolute path of the directory in which run directories are kept. None to remove them."""
    in_uml: bool
    """True to run processes in User Mode Linux."""
    image_from_host: bool
    """True to let containers use the files of this machine."""
    programs: Programs
    variant: Path | None
    """Absolute path of the file with a protocol variant."""
    rewrite: bool
    """True to rewrite stories. False to compare them with the runs."""

    @classmethod
    def of(cls, config: pytest.Config) -> "SessionOptions":
        """Return the options of a pytest session. Raises ScenarioError."""
        backend, seed, speedup, keep, variant = (
            config.getoption(f"--ucp-{name}") for name in ("backend", "seed", "speedup", "keep", "variant")
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
            variant and config.invocation_params.dir / variant,
            config.getoption("--ucp-rewrite"),
        )

    def applied_to(self, scenario: Scenario) -> Scenario:
        """Return a copy of the scenario that is changed by these options. Raises ScenarioError."""
        document = scenario.model_dump()
        if self.speedup is not None:
            document["speedup"] = self.speedup
        document |= command_keys(scenario, self.programs)
        if self.image_from_host:
            document["docker"]["image_from_host"] = True
        return parse(document) if document != scenario.model_dump() else scenario

    def refuse(self, backend: BackendName) -> None:
        """Raise MachineError if the backend cannot be used with the requested kernel."""
        if self.in_uml:
            from harness.pytest_plugin._kernel_option import refuse_outside

            refuse_outside(backend)
