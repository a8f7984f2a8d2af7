"""From a file to a scenario, and from what pydantic found to a sentence for a person."""

from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from harness.errors import ScenarioError
from harness.scenario.model import BOUNDED
from harness.scenario.scenario import Scenario

MAX_SCENARIO_BYTES = 1024 * 1024


def load_scenario(path: Path) -> Scenario:
    """Raises ScenarioError: one sentence that names the file, the key, the value and what is allowed."""
    try:
        if path.stat().st_size > MAX_SCENARIO_BYTES:
            raise ScenarioError(f"{path}: larger than {MAX_SCENARIO_BYTES} bytes, which no scenario is")
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it cannot be decoded"
        raise ScenarioError(f"{path}: not YAML{where}: {problem}") from None
    if not isinstance(document, dict):
        raise ScenarioError(f"{path}: a scenario is a YAML mapping with at least `name`")
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        raise ScenarioError(f"{path}: {explain(error, Scenario)}") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem that pydantic found, as one sentence for a person."""
    problems: list[Any] = error.errors()
    problem = max(problems, key=lambda candidate: len(candidate["loc"]))
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"`{key}` is unknown: there are {', '.join(_siblings(model, problem['loc']))}"
    if problem["type"] == "missing":
        return f"`{key}` is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not key:
        return str(message)
    shown = BOUNDED.repr(problem["input"])
    return f"`{key}` is {shown}: it {message}" if message.startswith("should") else f"`{key}` is {shown}: {message}"


def _siblings(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """The keys that are allowed beside the one at `location`."""
    current: Any = model
    for part in location[:-1]:
        if isinstance(part, str) and part in current.model_fields:
            annotation = current.model_fields[part].annotation
            candidates = [annotation, *getattr(annotation, "__args__", ())]
            current = next((one for one in candidates if isinstance(one, type) and issubclass(one, BaseModel)), current)
    return list(current.model_fields)
