"""Read a matrix file: a scenario with lists of loss rates, numbers of agents, mission lengths, backends and seeds.
Write the scenarios of a matrix as files, with which `ucp-harness run` can play each run again.
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import Field, ValidationError, field_validator, model_validator

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.play.backends import BACKENDS
from harness.scenario import Scenario, explain, load_scenario, read_yaml
from harness.scenario.scenario import MAX_DURATION_S
from harness.scenario.strict_model import MAX_AGENTS, Probability, Seconds, StrictModel
from ucp.agent_files import write_atomically
from ucp.short_value import shown

MAX_SEEDS = 10_000
MAX_SEED = 2**32 - 1
SIZES_FOR_GROWTH = 3
"""Minimum number of swarm sizes or mission lengths for which power laws are fitted. With only two of them, a power law
would always fit.
"""


class MatrixPoint(NamedTuple):
    """A combination of values in the matrix. `duration_s` is None if all runs have the same mission length."""

    loss: float
    agents: int
    backend: BackendName
    duration_s: float | None = None

    @property
    def file_name(self) -> str:
        """The name of this combination of values in the names of files and directories. It does not depend on the
        backend.
        """
        length = "" if self.duration_s is None else f"-duration-{self.duration_s}"
        return f"loss-{self.loss}-agents-{self.agents}{length}"


class MatrixTask(NamedTuple):
    """One run of the matrix: its combination of values, and its seed."""

    point: MatrixPoint
    seed: int


class Matrix(StrictModel):
    """A scenario and the values to vary: `backend`, `duration_s`, `agents`, `loss` and `seeds`.

    Each combination of values is one run. `loss` replaces the scenario's `network.loss`. `agents` and `duration_s`, if
    given, replace the scenario's keys of the same name. The scenario must not set a key that is replaced, because the
    two values could differ. All other parts of the scenario, such as its timeline, apply to every cell. Every cell has
    the same seeds, so the same blocks are built at the same times at every loss (common random numbers). A difference
    between two cells that differ only in their loss is therefore an effect of the loss.
    """

    name: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    scenario: Scenario
    """Keys of a scenario, or the path of a scenario file relative to the matrix file. By default, its `name` is the
    name of the matrix.
    """
    loss: Annotated[list[Probability], Field(min_length=1, max_length=100)]
    seeds: int | list[int] = 200
    """Either a list of seeds, or the number of seeds. With a number, the seeds are 1, 2 and so on."""
    agents: (
        Annotated[list[Annotated[int, Field(ge=1, le=MAX_AGENTS, strict=True)]], Field(min_length=1, max_length=100)]
        | None
    ) = None
    """Numbers of agents. By default, the number of agents in the scenario."""
    duration_s: (
        Annotated[list[Annotated[Seconds, Field(le=MAX_DURATION_S)]], Field(min_length=1, max_length=100)] | None
    ) = None
    """Mission lengths in mission seconds. By default, the mission length of the scenario."""
    backend: Annotated[list[BackendName], Field(min_length=1, default_factory=lambda: ["sim"])]
    """Backends, by default `sim`."""
    keep: Literal["violated", "all"] = "violated"
    """The run directories that are kept: those of runs with a violation or failure, or those of all runs. Simulated
    runs in memory have no directory.
    """
    traces: bool = True
    """True if agents write traces in virtual time. Without traces, a run of a large swarm takes a fifth of the time and
    far less memory, but the checker cannot judge characteristic 1, the steps and the records. Processes always write
    traces.
    """

    @property
    def needs_processes(self) -> bool:
        """True if any run of the matrix needs real processes. They may be inside or outside of containers."""
        return any(not BACKENDS[backend].plays_in_memory for backend in self.backend)

    @property
    def seed_list(self) -> list[int]:
        return list(range(1, self.seeds + 1)) if isinstance(self.seeds, int) else self.seeds

    @property
    def points(self) -> list[MatrixPoint]:
        agents = self.agents or [len(self.scenario.roster)]
        return [
            MatrixPoint(loss, number, backend, duration_s)
            for backend, duration_s, number, loss in product(self.backend, self.duration_axis, agents, self.loss)
        ]

    @property
    def tasks(self) -> list[MatrixTask]:
        return [MatrixTask(point, seed) for point in self.points for seed in self.seed_list]

    def scenario_at(self, point: MatrixPoint) -> Scenario:
        network = self.scenario.network.model_copy(update={"loss": point.loss})
        agents = point.agents if self.agents else self.scenario.agents
        duration_s = self.scenario.duration_s if point.duration_s is None else point.duration_s
        return self.scenario.model_copy(update={"network": network, "agents": agents, "duration_s": duration_s})

    @property
    def duration_axis(self) -> Sequence[float | None]:
        """The different mission lengths of the matrix. The list contains only None if all runs have the same mission
        length.
        """
        return self.duration_s or [None]

    @property
    def lengths(self) -> list[float]:
        """The mission lengths in seconds."""
        return self.duration_s or [self.scenario.duration_s]

    @property
    def grows_with_agents(self) -> bool:
        """True if the matrix has enough different numbers of agents to fit power laws."""
        return len(self.agents or ()) >= SIZES_FOR_GROWTH

    @property
    def grows_with_length(self) -> bool:
        """True if the matrix has enough different mission lengths to fit power laws."""
        return len(self.duration_s or ()) >= SIZES_FOR_GROWTH

    @property
    def grows(self) -> bool:
        return self.grows_with_agents or self.grows_with_length

    @model_validator(mode="before")
    @classmethod
    def _scenario_takes_from_the_matrix(cls, document: Any) -> Any:
        """Fill in the name, the number of agents and the mission length of the scenario.

        The number and the length are the first values of the matrix. They are used to check the keys of the scenario
        that contain agent IDs or times.
        """
        if not isinstance(document, dict):
            return document
        scenario = document.get("scenario")
        if isinstance(scenario, Scenario):
            scenario = scenario.model_dump(exclude_unset=True)
        if not isinstance(scenario, dict):
            return document
        if "name" in document:
            scenario = {"name": document["name"], **scenario}
        for axis in ("agents", "duration_s"):
            if values := document.get(axis):
                first = values[0] if isinstance(values, list) else values
                if scenario.get(axis, first) != first:
                    raise ValueError(
                        f"`scenario` sets {axis} to {shown(scenario[axis])}, but the key `{axis}` of the matrix "
                        "sets it: "
                        "remove it from `scenario`"
                    )
                scenario = {**scenario, axis: first}
        return {**document, "scenario": scenario}

    @model_validator(mode="after")
    def _scenario_fits_every_size(self) -> "Matrix":
        axes = {axis: values for axis in ("agents", "duration_s") if (values := getattr(self, axis))}
        document = self.scenario.model_dump()
        for size in product(*axes.values()) if axes else ():
            try:
                Scenario.model_validate({**document, **dict(zip(axes, size, strict=True))})
            except ValidationError as error:
                which = " and ".join(f"`{axis}` has {value:g}" for axis, value in zip(axes, size, strict=True))
                raise ValueError(f"`scenario` is wrong if {which}: {explain(error, Scenario)}") from None
        return self

    @field_validator("scenario")
    @classmethod
    def _loss_is_the_axis(cls, scenario: Scenario) -> Scenario:
        if scenario.network.loss:
            raise ValueError(
                f"sets network.loss to {scenario.network.loss}, but the key `loss` of the matrix sets it: remove "
                "network.loss"
            )
        return scenario

    @field_validator("agents", "duration_s", "backend", mode="before")
    @classmethod
    def _one_or_several(cls, value: Any) -> Any:
        return value if value is None or isinstance(value, list) else [value]

    @field_validator("loss", "agents", "duration_s", "backend")
    @classmethod
    def _each_once(cls, values: list[Any] | None) -> list[Any] | None:
        return values and _each_once(values)

    @field_validator("seeds", mode="before")
    @classmethod
    def _count_or_seeds(cls, seeds: Any) -> Any:
        if isinstance(seeds, int) and not isinstance(seeds, bool) and 1 <= seeds <= MAX_SEEDS:
            return seeds
        if not isinstance(seeds, list) or not 1 <= len(seeds) <= MAX_SEEDS:
            raise ValueError(f"it should be a number of seeds 1..{MAX_SEEDS}, or a list of them")
        for seed in seeds:
            if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
                raise ValueError(f"{shown(seed)} is not a seed: it should be 0..{MAX_SEED}")
        return _each_once(seeds)


def load_matrix(path: Path | str, backend: BackendName | None = None) -> Matrix:
    """Load a matrix from a YAML file. If `backend` is given, it replaces the backend in the file.

    Raises ScenarioError. Its message names the file, the key, the value and the allowed values.
    """
    path = Path(path)
    document = read_yaml(path, "matrix")
    of_matrix = Matrix.model_fields.keys() if "loss" in document else {"name", "about"}
    if "scenario" not in document and document.keys() & (Scenario.model_fields.keys() - of_matrix):
        raise ScenarioError(
            f"{path}: this is a scenario; a matrix names one, `scenario: {path.name}`, and `loss`, a list"
        )
    if backend is not None:
        document["backend"] = backend
    if isinstance(named := document.get("scenario"), str):
        document["scenario"] = load_scenario(path.parent / named)
    try:
        return Matrix.model_validate(document, context={"beside": path.parent})
    except ValidationError as error:
        raise ScenarioError(f"{path}: {explain(error, Matrix)}") from None


def _each_once(values: list[Any]) -> list[Any]:
    for index, value in enumerate(values):
        if value in values[:index]:
            raise ValueError(f"names {value} twice")
    return values


DIRECTORY = "cells"


def scenario_file(point: MatrixPoint) -> str:
    """Return the path of the scenario file, relative to the matrix's directory."""
    return f"{DIRECTORY}/{point.file_name}.yaml"


def write_scenarios(matrix: Matrix, directory: Path) -> None:
    """Write the scenarios for all combinations of values. Raises OSError if a file cannot be written."""
    (directory / DIRECTORY).mkdir(exist_ok=True)
    for path, point in {scenario_file(point): point for point in matrix.points}.items():
        scenario = matrix.scenario_at(point).model_dump(mode="json", exclude_defaults=True)
        text = yaml.safe_dump(scenario, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
        write_atomically(directory / path, text)
