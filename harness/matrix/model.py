"""The matrix file: which scenario, at which loss rates, with which seeds."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, field_validator, model_validator

from harness.errors import ScenarioError
from harness.scenario import Scenario, explain, load_scenario, read_yaml
from harness.scenario.model import BOUNDED, Model, Probability

MAX_SEEDS = 10_000
MAX_SEED = 2**32 - 1


class Matrix(Model):
    """A scenario, played at each rate of `loss` with each of `seeds`.

    `loss` takes the place of the scenario's `network.loss`, which therefore has to stay unset: two words for one thing
    could differ. Whatever else the scenario says of the network (receivers that differ, its timeline) holds in every
    cell. Every cell has the same seeds, so the same blocks are built at the same times in all of them: cells differ by
    their loss, not by their luck (common random numbers).
    """

    name: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    scenario: Scenario
    """Keys of a scenario (its `name` is the matrix's unless given), or the path of one, relative to the matrix file."""
    loss: Annotated[list[Probability], Field(min_length=1, max_length=100)]
    seeds: int | list[int] = 200
    """How many, counted from 1, or which."""

    @property
    def seed_list(self) -> list[int]:
        return list(range(1, self.seeds + 1)) if isinstance(self.seeds, int) else self.seeds

    def scenario_at(self, loss: float) -> Scenario:
        network = self.scenario.network.model_copy(update={"loss": loss})
        return self.scenario.model_copy(update={"network": network})

    @model_validator(mode="before")
    @classmethod
    def _scenario_has_a_name(cls, document: Any) -> Any:
        if isinstance(document, dict) and isinstance(document.get("scenario"), dict) and "name" in document:
            return {**document, "scenario": {"name": document["name"], **document["scenario"]}}
        return document

    @field_validator("scenario")
    @classmethod
    def _loss_is_the_axis(cls, scenario: Scenario) -> Scenario:
        if scenario.network.loss:
            raise ValueError(
                f"sets network.loss to {scenario.network.loss}, which the matrix's `loss` is for: remove it there"
            )
        return scenario

    @field_validator("loss")
    @classmethod
    def _each_rate_once(cls, loss: list[float]) -> list[float]:
        return _each_once(loss)

    @field_validator("seeds", mode="before")
    @classmethod
    def _count_or_seeds(cls, seeds: Any) -> Any:
        if isinstance(seeds, int) and not isinstance(seeds, bool) and 1 <= seeds <= MAX_SEEDS:
            return seeds
        if not isinstance(seeds, list) or not 1 <= len(seeds) <= MAX_SEEDS:
            raise ValueError(f"it should be a number of seeds 1..{MAX_SEEDS}, or a list of them")
        for seed in seeds:
            if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
                raise ValueError(f"{BOUNDED.repr(seed)} is not a seed: it should be 0..{MAX_SEED}")
        return _each_once(seeds)


def load_matrix(path: Path) -> Matrix:
    """Raises ScenarioError: one sentence that names the file, the key, the value and what is allowed."""
    document = read_yaml(path, "matrix")
    if isinstance(document.get("scenario"), str):
        document["scenario"] = load_scenario(path.parent / document["scenario"])
    try:
        return Matrix.model_validate(document)
    except ValidationError as error:
        raise ScenarioError(f"{path}: {explain(error, Matrix)}") from None


def _each_once(values: list[Any]) -> list[Any]:
    for index, one in enumerate(values):
        if one in values[:index]:
            raise ValueError(f"names {one} twice")
    return values
