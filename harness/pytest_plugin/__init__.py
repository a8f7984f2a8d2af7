"""Provide the pytest fixtures `swarm` and `scenario`. Scenarios with an `expect:` section, and stories, also become
tests.

pytest loads this module in every session, so it imports the rest of the harness only when a test uses a fixture.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from harness.backend_names import BACKEND_NAMES
from harness.pytest_plugin._stash import TRIAL

if TYPE_CHECKING:
    from harness.pytest_plugin.findings import Findings
    from harness.pytest_plugin.swarm_in_test import Swarm

MARKERS = (
    "swarm(agents=5, backend='sim', seed=1, variant=None, ...): configure the fixture `swarm` with any keys of a "
    "scenario",
    "scenario(file, backend='sim', seed=1, variant=None): the scenario of the fixture `scenario`. Paths are relative "
    "to the test's directory",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("ucp", "UCP harness")
    group.addoption(
        "--ucp-backend", choices=BACKEND_NAMES, help="Backend of all runs, instead of that of tests and scenarios."
    )
    group.addoption(
        "--ucp-seed", type=int, metavar="N", help="Seed of all runs, instead of that of tests and scenarios."
    )
    group.addoption(
        "--ucp-speedup", type=float, metavar="X", help="Mission seconds per second of wall time, for processes."
    )
    group.addoption(
        "--ucp-keep",
        type=Path,
        metavar="DIR",
        help="Keep all run directories in DIR. Default: keep those of failed tests in pytest's temporary directories.",
    )
    group.addoption(
        "--ucp-kernel",
        choices=("host", "uml"),
        default="host",
        help="This machine's kernel, or run the session in User Mode Linux, which has netem and needs no root.",
    )
    group.addoption(
        "--ucp-image-from-host",
        action="store_true",
        help="Run containers from this machine's files, and build or pull no image.",
    )
    group.addoption(
        "--ucp-agent",
        metavar="[ID=]COMMAND",
        action="append",
        help="Agent of all runs, instead of that of scenarios; ID= limits it to one agent. Repeatable.",
    )
    group.addoption(
        "--ucp-variant",
        type=Path,
        metavar="FILE",
        help="Python file with a protocol variant, for agents and judge of all runs.",
    )
    group.addoption(
        "--ucp-rewrite", action="store_true", help="Write the present behaviour of the agents into *.story files."
    )


def pytest_configure(config: pytest.Config) -> None:
    for marker in MARKERS:
        config.addinivalue_line("markers", marker)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> int | None:
    if config.getoption("--ucp-kernel") == "host":
        return None
    from harness.pytest_plugin._kernel_option import session_inside

    return session_inside(config)


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    if file_path.suffix == ".story":
        from harness.report.stories.story_file import is_story

        if not is_story(file_path):
            return None
        from harness.pytest_plugin._items import StoryFile

        return StoryFile.from_parent(parent, path=file_path)
    if file_path.suffix not in (".yaml", ".yml"):
        return None
    from harness.pytest_plugin._yaml_files import is_expectation_scenario, is_selected

    if not is_selected(file_path, parent.config) or not is_expectation_scenario(file_path):
        return None
    from harness.pytest_plugin._items import ScenarioFile

    return ScenarioFile.from_parent(parent, path=file_path)


@pytest.fixture
def swarm(request: pytest.FixtureRequest) -> Iterator[Swarm]:
    """Provide a swarm that the test controls. By default, it has five agents and no loss. Markers change these
    values.
    """
    from harness.pytest_plugin._fixtures import swarm_for

    yield from swarm_for(request.node)


@pytest.fixture
def scenario(request: pytest.FixtureRequest) -> Iterator[Findings]:
    """Provide the verdicts and numeric results of one run of the scenario that the marker `scenario` names."""
    from harness.pytest_plugin._fixtures import scenario_for

    yield from scenario_for(request.node)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    """Judge the run as a part of its test, because a violation after the end of the test could not make the test
    fail.
    """
    try:
        yield
    except Exception:
        if trial := item.stash.get(TRIAL, None):
            item.add_report_section("call", "ucp", trial.end_of_failed_test())
        raise
    if trial := item.stash.get(TRIAL, None):
        trial.end_of_test()
