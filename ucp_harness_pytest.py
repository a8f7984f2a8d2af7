"""Where pytest comes in: it loads this module wherever the harness is installed, and this one the plugin.

Its name is nobody else's. `harness`, `ucp`, `netem` and `sitl` may well be: pytest has the folders of a project on the
path before the installed packages (`python -m pytest`, `pythonpath = .`, a conftest.py), and then a project's own
`harness/` would be where the plugin is looked for, in all of its tests.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

import pytest

INSTALLED = Path(__file__).parent
HAS = {
    "harness": "pytest_plugin/__init__.py",
    "ucp": "agent.py",
    "netem": "lab.py",
    "sitl": "embedded.py",
}
"""Our packages, and by what each is known, whichever copy of it is first on the path."""


def folders_of_others(place: Path) -> list[str]:
    """The packages in there that have a name of ours and are not."""
    return [name for name, file in HAS.items() if _is_package(place / name) and not (place / name / file).is_file()]


def _is_package(folder: Path) -> bool:
    return (folder / "__init__.py").is_file()


def _import_ours() -> None:
    """Have these names mean our packages for good, if they would mean another's now."""
    for name, file in HAS.items():
        spec = importlib.util.find_spec(name)
        if spec is not None and any(Path(place, file).is_file() for place in spec.submodule_search_locations or ()):
            continue
        if name in sys.modules:
            raise pytest.UsageError(
                f"the package {name} of {Path(spec.origin or '.').parent if spec else 'somebody'} is loaded already, "
                f"and ucp-harness has one of this name: rename it, or leave the plugin out: -p no:ucp-harness"
            )
        sys.path.insert(0, str(INSTALLED))
        try:
            importlib.invalidate_caches()
            importlib.import_module(name)
        finally:
            sys.path.remove(str(INSTALLED))


_import_ours()
pytest_plugins = ["harness.pytest_plugin"]


def pytest_configure(config: pytest.Config) -> None:
    """Say what a project cannot import, before one of its tests wonders why."""
    for place in dict.fromkeys([config.rootpath, *(Path(entry).absolute() for entry in sys.path)]):
        if names := folders_of_others(place):
            config.issue_config_time_warning(
                pytest.PytestWarning(
                    f"tests cannot import {' and '.join(names)} of {place}: ucp-harness has packages of the same name; "
                    "rename yours, or run tests that need no swarm with -p no:ucp-harness"
                ),
                stacklevel=2,
            )
