"""Load a scenario from a file or from the included library, and explain validation errors in one sentence."""

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError

from harness.errors import ScenarioError
from harness.present.text import did_you_mean
from harness.scenario._yaml_loader import YamlLoader
from harness.scenario.scenario import Scenario
from ucp.plain_file import read_text
from ucp.short_value import shown, shown_key

_PACKAGE = Path(__file__).parents[1]
_INSIDE = _PACKAGE / "scenarios"
LIBRARY = _INSIDE if _INSIDE.is_dir() else _PACKAGE.parent / "scenarios"
"""Folder of the scenario library: inside an installed package, or next to the package in a checkout. It may be
missing."""


def scenario_names() -> list[str]:
    """Return the names of all included scenarios in alphabetical order."""
    return sorted(path.stem for path in LIBRARY.glob("*.yaml"))


def find_file(path: Path) -> Path:
    """Return `path` if this file exists. If it does not exist and `path` is the name of an included scenario, return
    the path of this scenario. Otherwise return `path`.
    """
    file_name = f"{path}.yaml"
    if len(path.parts) != 1 or not LIBRARY.is_dir() or file_name not in (file.name for file in LIBRARY.iterdir()):
        return path
    return path if path.exists() else LIBRARY / file_name


def first_sentence(name: str) -> str:
    """Return the first sentence of the comment at the top of an included scenario."""
    comment = []
    for line in (LIBRARY / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    return " ".join(comment).partition(". ")[0].removesuffix(".") + "."


MAX_ERRORS = 20_000
"""Maximum number of validation errors that are described. The description of each takes a kilobyte."""
MAX_PROBLEM = 200
"""Maximum number of characters of a parser message that an error contains."""
MAX_FILES_BESIDE = 1000
MAX_SCENARIO_BYTES = 8 * 1024 * 1024
"""Maximum size of a scenario file in bytes. The events of a flight of two hours with twenty vehicles need half of this
size.
"""


def load_scenario(path: Path | str) -> Scenario:
    """Load a scenario from a YAML file, or from the library by its name, such as "loss_15". Raises ScenarioError with a
    message that names the file, the key, the value and the allowed values.
    """
    path = Path(path)
    document = read_yaml(path, "scenario")
    if "scenario" in document:
        raise ScenarioError(f"{path}: this is a matrix: play it with `ucp-harness matrix {path}`")
    try:
        return parse(document, beside=find_file(path).parent)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None


def parse(document: dict[str, Any], beside: Path | None = None) -> Scenario:
    """Return the scenario in a YAML document. File names in the document are relative to the directory `beside`. Raises
    ScenarioError with a message that names the key, the value and the allowed values.
    """
    try:
        return Scenario.model_validate(document, context={"beside": beside})
    except ValidationError as error:
        raise ScenarioError(explain(error, Scenario)) from None


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text. Raises ScenarioError whose message starts with "not YAML"."""
    try:
        return yaml.load(text, YamlLoader)  # type: ignore[arg-type]  # noqa: S506  (a safe loader)
    except RecursionError:
        where, problem = "", "it is nested too deeply"
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or getattr(error, "reason", None) or "it cannot be read")
    except ValueError as error:  # a date that is none, a number of thousands of digits
        where, problem = "", f"an invalid value: {str(error).partition(':')[0].partition(';')[0]}"
    raise ScenarioError(f"not YAML{where}: {problem[:MAX_PROBLEM]}")


def read_yaml(path: Path, what: str) -> dict[str, object]:
    """Return the mapping in a YAML file, or in the included file of this name. `what` is the word for such a file in
    error messages, such as "scenario". Raises ScenarioError.
    """
    path = find_file(path)
    try:
        text = read_text(path, MAX_SCENARIO_BYTES)
    except FileNotFoundError:
        names = "`ucp-harness scenarios` lists the included scenarios"
        hint = did_you_mean(path, _near(path)) or did_you_mean(path.stem, scenario_names())
        raise ScenarioError(f"{path}: no such file or {what}; {names}{hint}") from None
    except OSError as error:
        raise ScenarioError(f"{str(path)[:MAX_PROBLEM]}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{path}: not YAML: it is not UTF-8 text") from None
    try:
        document = parse_yaml(text)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    if not isinstance(document, dict):
        raise ScenarioError(f"{path}: a {what} is a YAML mapping with at least `name`")
    return document


def _near(path: Path) -> Iterator[str]:
    """Yield suggestions when a file is missing: the names of the included scenarios, and the YAML files in the same
    directory.
    """
    if len(path.parts) == 1:
        yield from scenario_names()
    yield from (str(file) for file in islice(path.parent.glob("*.y*ml"), MAX_FILES_BESIDE))


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the most specific problem that pydantic found, as one sentence."""
    if error.error_count() > MAX_ERRORS:
        return f"{error.error_count()} errors in it"
    problems: list[Any] = error.errors()
    problem = max(problems, key=lambda candidate: (len(candidate["loc"]), candidate["type"] == "extra_forbidden"))
    key = ".".join(shown_key(part) for part in problem["loc"])
    if problem["type"] in ("extra_forbidden", "invalid_key"):
        allowed = _siblings(model, problem["loc"])
        return f"`{key}` is unknown: use one of {', '.join(allowed)}{did_you_mean(problem['loc'][-1], allowed)}"
    if problem["type"] == "missing":
        return f"`{key}` is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ").removeprefix("String ")
    if not key:
        return str(message)
    value = shown(problem["input"])
    if problem["type"] == "list_type" and isinstance(problem["input"], int | float | str):
        message += f", as [{value}]"
    if problem["type"] == "literal_error":
        message += did_you_mean(problem["input"], re.findall(r"'([^']*)'", problem["ctx"]["expected"]))
    return (
        f"`{key}` is {value}: it {message}"
        if message.startswith(("should", "must"))
        else f"`{key}` is {value}: {message}"
    )


def _siblings(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """Return the keys that are allowed at a place of the document."""
    current = model
    for part in location[:-1]:
        for name, field in current.model_fields.items():
            if part in (name, field.alias):
                current = next(_models(field.annotation), current)
                break
    return [field.alias or name for name, field in current.model_fields.items()]


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the pydantic model classes in a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)
