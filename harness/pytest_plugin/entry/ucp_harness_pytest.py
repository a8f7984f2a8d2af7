"""The module that pytest loads first. It loads the plugin, unless Python would import foreign packages in place of the
harness's packages.

A project may have a folder with the name of one of the harness's packages, and a process can import only one of the
two. In this case the plugin is not loaded, and the project's tests run as if it were not installed. A test that uses a
fixture of the harness then fails with this reason.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from pathlib import Path
from typing import NoReturn

import pytest

OURS = {"harness": "pytest_plugin", "ucp": "quirks", "sitl": "pilot.py", "netem": "lab.py"}
"""Package of the harness -> a file or folder in it that no other package of this name contains."""


def find_foreign_packages() -> list[Path]:
    """Return packages from elsewhere that Python imports instead of the harness's packages, because they have the same
    names.
    """
    here = Path.cwd()
    places = [here / name for name in OURS if (here / name / "__init__.py").exists()]
    for name in OURS:
        spec = PathFinder.find_spec(name)
        places += map(Path, spec.submodule_search_locations or () if spec else ())
    return [place for place in dict.fromkeys(places) if not (place / OURS[place.name]).exists()]


if hidden := find_foreign_packages():
    WHY = (
        f"ucp-harness is not importable: {' and '.join(map(str, hidden))} "
        f"{'has the name of one' if len(hidden) == 1 else 'have names'} of its packages; "
        f"rename {'the folder' if len(hidden) == 1 else 'them'}, or call pytest in a directory without"
    )

    def pytest_report_header() -> str:
        return WHY

    def pytest_configure(config: pytest.Config) -> None:
        for marker in ("swarm", "scenario"):
            config.addinivalue_line("markers", f"{marker}: {WHY}")

    @pytest.fixture
    def swarm() -> NoReturn:
        """Fail with the reason why the plugin is not loaded."""
        pytest.fail(WHY, pytrace=False)

    @pytest.fixture
    def scenario() -> NoReturn:
        """Fail with the reason why the plugin is not loaded."""
        pytest.fail(WHY, pytrace=False)

else:
    pytest_plugins = ("harness.pytest_plugin",)
