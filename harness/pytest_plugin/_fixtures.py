"""Implement the fixtures `swarm` and `scenario`. This module is imported when a test uses one of them."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from harness.backend_names import BACKEND_NAMES, BackendName
from harness.errors import ScenarioError
from harness.play.progress import SilentProgress
from harness.pytest_plugin._judged_run import RunOfOneTest, discard, new_directory, one_sentence
from harness.pytest_plugin._options import SessionOptions
from harness.pytest_plugin._stash import TRIAL
from harness.pytest_plugin.findings import Findings
from harness.pytest_plugin.swarm_in_test import Swarm
from harness.run.run import Run, run
from harness.run.variant_in_force import in_force
from harness.scenario import Scenario, load_scenario
from harness.scenario.load import find_file, parse

DEFAULTS: dict[str, Any] = {"backend": "sim", "seed": 1, "variant": None}


def swarm_for(node: pytest.Item) -> Iterator[Swarm]:
    """Yield the swarm of a test. If the test is aborted, this function ends the run."""
    with ExitStack() as stack:
        with one_sentence():
            options = SessionOptions.of(node.config)
            keys = {**DEFAULTS, "name": node.name[:200], "vehicles": {"kind": "none"}}
            for marker in reversed(list(node.iter_markers("swarm"))):  # the nearest marker overrides the others
                keys |= marker.kwargs
            backend, seed = _backend_and_seed(keys.pop("backend"), keys.pop("seed"), options)
            variant = _variant(keys.pop("variant"), node, options)
            options.refuse(backend)
            scenario = options.applied_to(parse(keys))
            stack.enter_context(in_force(variant))
            directory = new_directory(node, options)
            swarm = Swarm(scenario, seed, backend, directory)
        trial = node.stash[TRIAL] = RunOfOneTest(scenario, swarm.finish, variant)
        stack.callback(swarm.close)
        yield swarm
    if trial.passed:
        discard(directory, options)


def scenario_for(node: pytest.Item) -> Iterator[Findings]:
    """Run the scenario that the marker names. Yield its verdicts and numeric results."""
    with one_sentence():
        options = SessionOptions.of(node.config)
        path, keys = _marked(node)
        backend, seed = _backend_and_seed(keys["backend"], keys["seed"], options)
        variant = _variant(keys["variant"], node, options)
        options.refuse(backend)
        scenario = options.applied_to(load_scenario(path))
        directory = new_directory(node, options)
        finished = play(scenario, seed, backend, directory, variant)
    trial = node.stash[TRIAL] = RunOfOneTest(scenario, lambda _: finished, variant)
    yield Findings(directory, finished.result)
    if trial.passed:
        discard(directory, options)


def play(
    scenario: Scenario,
    seed: int,
    backend: BackendName,
    directory: Path,
    variant: Path | None,
    *,
    delivers_all: bool = False,
) -> Run:
    """Run and judge a scenario. Raises HarnessError, and KeyboardInterrupt if the run was interrupted."""
    with in_force(variant):
        finished = run(scenario, seed, directory, SilentProgress(), backend, delivers_all=delivers_all)
    if finished.played.outcome == "interrupted":
        raise KeyboardInterrupt(f"{finished.played.outcome_detail}; report: {finished.report}")
    return finished


def _marked(node: pytest.Item) -> tuple[Path, dict[str, Any]]:
    marker = node.get_closest_marker("scenario")
    if marker is None or len(marker.args) != 1 or not marker.kwargs.keys() <= DEFAULTS.keys():
        raise ScenarioError(
            "the fixture `scenario` needs a marker with a scenario, and optionally a backend, a seed and a variant: "
            '@pytest.mark.scenario("loss_15.yaml", backend="sim", seed=3)'
        )
    path = node.path.parent / marker.args[0]
    included = find_file(Path(marker.args[0]))
    return path if path.exists() or not included.is_absolute() else included, {**DEFAULTS, **marker.kwargs}


def _variant(marked: Any, node: pytest.Item, options: SessionOptions) -> Path | None:
    """Return the file of the protocol variant, or None for the original protocol. A command-line option takes
    precedence over the marker. Raises ScenarioError.
    """
    if marked is not None and not isinstance(marked, str | Path):
        raise ScenarioError(f"`variant` is {marked!r}: use the path of a Python file")
    return options.variant or (node.path.parent / marked if marked is not None else None)


def _backend_and_seed(backend: Any, seed: Any, options: SessionOptions) -> tuple[BackendName, int]:
    """Return the backend and the seed. Command-line options take precedence over the marker. Raises ScenarioError."""
    if backend not in BACKEND_NAMES:
        *names, last = map(repr, BACKEND_NAMES)
        raise ScenarioError(f"`backend` is {backend!r}: use {', '.join(names)} or {last}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ScenarioError(f"`seed` is {seed!r}: use a number from 0 on")
    return options.backend or backend, seed if options.seed is None else options.seed
