"""Decide which YAML files are scenarios that contain expectations.

Other YAML files are not parsed, because a project may have many of them.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

MAX_BYTES = 8 * 1024 * 1024
TOP_LEVEL_KEY = re.compile(rb"^([A-Za-z_][\w-]*)[ \t]*:", re.MULTILINE)
PLACES: pytest.StashKey[list[Path]] = pytest.StashKey()
EXPECTED = re.compile(rb"\b(?:characteristics|figures|chains|backends|seeds)[\"']?[ \t]*:")
EMPTY_SECTION = re.compile(rb"[ \t]*(?:\{[ \t]*\})?[ \t]*(?:#.*)?\s*")


def is_selected(path: Path, config: pytest.Config) -> bool:
    """Return true if the user selected the file with a path in the pytest command, or with the option `testpaths` of
    the configuration. For example, `pytest .` selects all files below the current directory.
    """
    if PLACES not in config.stash:
        config.stash[PLACES] = _places(config)
    return any(path.is_relative_to(place) for place in config.stash[PLACES])


def _places(config: pytest.Config) -> list[Path]:
    root = config.rootpath
    testpaths = [path for pattern in config.getini("testpaths") for path in _matching(root, pattern)]
    if config.args_source is not pytest.Config.ArgsSource.ARGS:
        return testpaths
    named = (config.invocation_params.dir / argument.split("::")[0] for argument in config.args)
    return [*testpaths, *(Path(os.path.normpath(path)) for path in named)]


def _matching(root: Path, pattern: str) -> Iterable[Path]:
    """Return the paths that match one entry in pytest's configuration. The entry is a path or a pattern."""
    path = root / pattern
    return [path] if path.exists() else root.glob(pattern)


def is_expectation_scenario(path: Path) -> bool:
    """Return true if the top-level keys of the file are those of a scenario with an `expect` section.

    The section must contain one of the known keys. If the section is empty, all top-level keys of the file must be keys
    of a scenario. If the keys of the section are misspelt, the file must have more keys than `name` and `expect`,
    because test files of other tools have these two keys.
    """
    try:
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            return False
        text = path.read_bytes()  # without `ucp.plain_file`, because a project may have its own package `ucp`
    except OSError:
        return False
    keys = {key[1]: key for key in TOP_LEVEL_KEY.finditer(text)}
    if not {b"name", b"expect"} <= keys.keys():
        return False
    begin = keys[b"expect"].end()
    end = min((key.start() for key in keys.values() if key.start() > begin), default=len(text))
    if EXPECTED.search(text, begin, end):
        return True
    empty = EMPTY_SECTION.fullmatch(text, begin, end) is not None
    return (empty or keys.keys() > {b"name", b"expect"}) and _are_keys_of_a_scenario(keys)


def _are_keys_of_a_scenario(keys: Iterable[bytes]) -> bool:
    from harness.scenario import Scenario

    return {key.decode() for key in keys} <= Scenario.model_fields.keys()
