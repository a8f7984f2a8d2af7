"""The matrix file: which scenario, at which loss rates, with how many agents, by which backends, with which seeds."""

from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, ValidationError, field_validator, model_validator

from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.play.backends import BACKENDS
from harness.scenario import Scenario, explain, load_scenario, read_yaml
from harness.scenario.strict_model import MAX_AGENTS, Model, Probability
from ucp.short_value import shown

MAX_SEEDS = 10_000
MAX_SEED = 2**32 - 1


class Point(NamedTuple):
    """Where a cell stands in the matrix."""

    loss: float
    agents: int
    backend: BackendName

    @property
    def file_name(self) -> str:
        """What its files and directories are called; those of all backends."""
        return f"loss-{self.loss}-agents-{self.agents}"


class Task(NamedTuple):
    """One run that is asked for."""

    point: Point
    seed: int


class Matrix(Model):
    """A scenario, played by each `backend` with each number of `agents` at each rate of `loss` with each of `seeds`.

    `loss` takes the place of the scenario's `network.loss`, and `agents`, if given, of its `agents`, which therefore
    have to stay unset: two words for one thing could differ. Whatever else the scenario says of the network (receivers
    that differ, its timeline) holds in every cell. Every cell has the same seeds, so the same blocks are built at the
    same times at every loss: cells differ by their loss, not by their luck (common random numbers).
    """

    name: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    scenario: Scenario
    """Keys of a scenario (its `name` is the matrix's unless given), or the path of one, relative to the matrix file."""
    loss: Annotated[list[Probability], Field(min_length=1, max_length=100)]
    seeds: int | list[int] = 200
    """How many, counted from 1, or which."""
    agents: (
        Annotated[list[Annotated[int, Field(ge=1, le=MAX_AGENTS, strict=True)]], Field(min_length=1, max_length=100)]
        | None
    ) = None
    """One number or several; the scenario's if not given."""
    backend: Annotated[list[BackendName], Field(min_length=1, default_factory=lambda: ["sim"])]
    """One or several."""
    keep: Literal["violated", "all"] = "violated"
    """Of which runs as processes the directories are kept: those that violated a characteristic or failed, or all."""

    @property
    def needs_processes(self) -> bool:
        """Whether any run is for real, in containers or without."""
        return any(not BACKENDS[backend].plays_in_memory for backend in self.backend)

    @property
    def seed_list(self) -> list[int]:
        return list(range(1, self.seeds + 1)) if isinstance(self.seeds, int) else self.seeds

    @property
    def points(self) -> list[Point]:
        agents = self.agents or [len(self.scenario.roster)]
        return [Point(loss, number, backend) for backend, number, loss in product(self.backend, agents, self.loss)]

    @property
    def tasks(self) -> list[Task]:
        return [Task(point, seed) for point in self.points for seed in self.seed_list]

    def scenario_at(self, point: Point) -> Scenario:
        network = self.scenario.network.model_copy(update={"loss": point.loss})
        agents = point.agents if self.agents else self.scenario.agents
        return self.scenario.model_copy(update={"network": network, "agents": agents})

    @model_validator(mode="before")
    @classmethod
    def _scenario_takes_from_the_matrix(cls, document: Any) -> Any:
        """Its name, and the first number of agents, so that what it says of single agents has a meaning."""
        if not isinstance(document, dict):
            return document
        scenario, agents = document.get("scenario"), document.get("agents")
        if isinstance(scenario, Scenario):
            scenario = scenario.model_dump(exclude_unset=True)
        if not isinstance(scenario, dict):
            return document
        if "name" in document:
            scenario = {"name": document["name"], **scenario}
        if agents:
            first = agents[0] if isinstance(agents, list) else agents
            if scenario.get("agents", first) != first:
                its_agents = shown(scenario["agents"])
                raise ValueError(
                    f"`scenario` sets agents to {its_agents}, which the matrix's `agents` is for: remove it there"
                )
            scenario = {**scenario, "agents": first}
        return {**document, "scenario": scenario}

    @model_validator(mode="after")
    def _scenario_fits_every_number_of_agents(self) -> "Matrix":
        for agents in self.agents or ():
            try:
                Scenario.model_validate({**self.scenario.model_dump(), "agents": agents})
            except ValidationError as error:
                raise ValueError(
                    f"`agents` has {agents}, for which `scenario` is wrong: {explain(error, Scenario)}"
                ) from None
        return self

    @field_validator("scenario")
    @classmethod
    def _loss_is_the_axis(cls, scenario: Scenario) -> Scenario:
        if scenario.network.loss:
            raise ValueError(
                f"sets network.loss to {scenario.network.loss}, which the matrix's `loss` is for: remove it there"
            )
        return scenario

    @field_validator("agents", "backend", mode="before")
    @classmethod
    def _one_or_several(cls, value: Any) -> Any:
        return value if value is None or isinstance(value, list) else [value]

    @field_validator("loss", "agents", "backend")
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
    """Load a matrix from a YAML file; `backend`, if given, replaces the file's.

    Raises ScenarioError, whose one sentence names the file, the key, the value and what is allowed.
    """
    path = Path(path)
    document = read_yaml(path, "matrix")
    if "scenario" not in document and document.keys() & (Scenario.model_fields.keys() - Matrix.model_fields.keys()):
        raise ScenarioError(
            f"{path}: this is a scenario; a matrix names one, `scenario: {path.name}`, and `loss`, a list"
        )
    if backend is not None:
        document["backend"] = backend
    if isinstance(document.get("scenario"), str):
        document["scenario"] = load_scenario(path.parent / document["scenario"])
    try:
        return Matrix.model_validate(document, context={"beside": path.parent})
    except ValidationError as error:
        raise ScenarioError(f"{path}: {explain(error, Matrix)}") from None


def _each_once(values: list[Any]) -> list[Any]:
    for index, value in enumerate(values):
        if value in values[:index]:
            raise ValueError(f"names {value} twice")
    return values
