"""A scenario with an `expect` section as tests: one for each backend and seed."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from harness.backend_names import BackendName
from harness.errors import HarnessError
from harness.pytest_plugin.directories import discard, new_directory
from harness.pytest_plugin.fixtures import play
from harness.pytest_plugin.judged_run import Trial, one_sentence
from harness.pytest_plugin.options import Options
from harness.pytest_plugin.stash import TRIAL
from harness.scenario import Scenario, load_scenario
from harness.scenario.expect import Expect


class ScenarioFile(pytest.File):
    def collect(self) -> Iterator[pytest.Item]:
        try:
            options = Options.of(self.config)
            scenario = options.laid_over(load_scenario(self.path))
        except HarnessError as error:
            raise self.CollectError(str(error)) from None
        expect = scenario.expect or Expect()
        backends = expect.backends if options.backend is None else [options.backend]
        seeds = expect.seeds if options.seed is None else [options.seed]
        for backend, seed in product(backends, seeds):
            name = f"{backend}-seed{seed}"
            yield ScenarioItem.from_parent(self, name=name, scenario=scenario, backend=backend, seed=seed)


class ScenarioItem(pytest.Item):
    """One run; whether it is as expected is judged where that of every test is (`pytest_runtest_call`)."""

    def __init__(self, *, scenario: Scenario, backend: BackendName, seed: int, **node: Any) -> None:
        super().__init__(**node)
        self._scenario = scenario
        self._backend = backend
        self._seed = seed
        self._directory: Path | None = None

    def runtest(self) -> None:
        with one_sentence():
            options = Options.of(self.config)
            options.refuse(self._backend)
            self._directory = new_directory(self, options)
            finished = play(self._scenario, self._seed, self._backend, self._directory)
        self.stash[TRIAL] = Trial(self._scenario, lambda _: finished)

    def teardown(self) -> None:
        if self._directory is not None and TRIAL in self.stash and self.stash[TRIAL].passed:
            discard(self._directory, Options.of(self.config))

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, f"{self.path.name}::{self.name}"
