"""What pytest loads wherever the harness is installed: the plugin, if its packages are ours.

A project may have a folder with the name of one of our packages, and two of one name cannot be in one process. Then
there is no plugin, and the project's tests run as they would without it; a test that asks for a fixture of the harness
is told why there is none.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from pathlib import Path
from typing import NoReturn

import pytest

OURS = {"harness": "pytest_plugin", "ucp": "quirks", "sitl": "pilot.py", "netem": "lab.py"}
"""Each package, and what is in ours."""


def others() -> list[Path]:
    """Packages that have the name of one of ours, and are where Python looks before, or will."""
    here = Path.cwd()
    places = [here / name for name in OURS if (here / name / "__init__.py").exists()]
    for name in OURS:
        spec = PathFinder.find_spec(name)
        places += map(Path, spec.submodule_search_locations or () if spec else ())
    return [place for place in dict.fromkeys(places) if not (place / OURS[place.name]).exists()]


if hidden := others():
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
        """Is not there."""
        pytest.fail(WHY, pytrace=False)

    @pytest.fixture
    def scenario() -> NoReturn:
        """Is not there."""
        pytest.fail(WHY, pytrace=False)

else:
    pytest_plugins = ("harness.pytest_plugin",)
