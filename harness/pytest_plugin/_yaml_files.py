"""Which YAML files are tests of ours, found out without parsing those that are not: a project has many others."""

import os
import re
from collections.abc import Iterable
from pathlib import Path

import pytest

MAX_BYTES = 8 * 1024 * 1024
TOP_LEVEL_KEY = re.compile(rb"^([A-Za-z_][\w-]*)[ \t]*:", re.MULTILINE)
PLACES: pytest.StashKey[list[Path]] = pytest.StashKey()
EXPECTED = re.compile(rb"\b(?:characteristics|figures|chains|backends|seeds)[\"']?[ \t]*:")
NOTHING_SPECIAL = re.compile(rb"[ \t]*(?:\{[ \t]*\})?[ \t]*(?:#.*)?\s*")


def is_asked_for(path: Path, config: pytest.Config) -> bool:
    """Whether it, or a directory round it, is a testpath or named on the command line; `pytest .` names the root."""
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
    """What a testpath stands for, which may be a pattern."""
    path = root / pattern
    return [path] if path.exists() else root.glob(pattern)


def is_ours(path: Path) -> bool:
    """Whether it looks like a scenario with an `expect` section: by its top-level keys, which begin a line.

    The section has one of its keys. Where it is empty or its keys are misspelt, all top-level keys are a scenario's,
    and in the second case more than a name: other tools' tests have names and expect things too.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            return False
        text = path.read_bytes()
    except OSError:
        return False
    keys = {key[1]: key for key in TOP_LEVEL_KEY.finditer(text)}
    if not {b"name", b"expect"} <= keys.keys():
        return False
    begin = keys[b"expect"].end()
    end = min((key.start() for key in keys.values() if key.start() > begin), default=len(text))
    if EXPECTED.search(text, begin, end):
        return True
    empty = NOTHING_SPECIAL.fullmatch(text, begin, end) is not None
    return (empty or keys.keys() > {b"name", b"expect"}) and _are_keys_of_a_scenario(keys)


def _are_keys_of_a_scenario(keys: Iterable[bytes]) -> bool:
    from harness.scenario import Scenario

    return {key.decode() for key in keys} <= Scenario.model_fields.keys()
