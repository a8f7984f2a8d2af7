"""What a scenario expects of its runs: which verdicts, figures, chains and mistakes; where, and with which seeds.

expect:
  characteristics: {1: holds, 5: holds, 6: not applicable}
  steps: as specified
  records: agree
  liveness: finished
  figures: {mutual_chain: {min: 40}, distinct_chains: 1, reconciles: {max: 20}}
  chains: {10: 5f0c...}
  common: [{agents: [10, 28], blocks: {min: 40}}, {agents: [32], blocks: {max: 20}}]
  deviations: {32: reconcile_phase_2_timer_expiration}
  backends: [sim, process]
  seeds: [1, 2, 3]
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import takewhile
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field, field_validator, model_validator

from harness.backend_names import BackendName
from harness.scenario.strict_model import Model, VehicleId, VehicleKey
from harness.scenario.verdict_names import (
    BESIDE,
    CHARACTERISTICS,
    CharacteristicVerdict,
    LivenessVerdict,
    RecordsVerdict,
    StepsVerdict,
    kind_of,
)
from ucp.agent import HANDLERS
from ucp.short_value import shown

FigureName = Literal[
    "agents",
    "blocks",
    "mutual_chain",
    "longest_chain",
    "distinct_chains",
    "copies_min",
    "copies_mean",
    "uniform_at_s",
    "reconciles",
    "messages",
    "bytes",
    "messages_per_block",
    "mutual_chain_before_final_reconcile",
    "distinct_chains_before_final_reconcile",
]
"""As in `harness.checker._figures`."""

NUMBERS = {number: int(number) for number in CHARACTERISTICS}
"""The characteristics; JSON has strings for keys."""

ChainHash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Number = Annotated[float, Field(allow_inf_nan=False)]


def _known_number(key: Any) -> int:
    number = NUMBERS.get(str(key))
    if number is None or isinstance(key, float):
        raise ValueError(f"there is no characteristic {shown(key)}: they are 1 to 6")
    return number


class Range(Model):
    """From `min` to `max`, both included; at least one of them."""

    min: Number | None = None
    max: Number | None = None

    @model_validator(mode="after")
    def _means_something(self) -> "Range":
        if self.min is None and self.max is None:
            raise ValueError("needs `min` or `max`")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is more than max {self.max:g}")
        return self

    def __contains__(self, figure: float) -> bool:
        return (self.min is None or figure >= self.min) and (self.max is None or figure <= self.max)

    def describe(self) -> str:
        """In words: "at least 40"."""
        if self.min == self.max:
            return f"{self.min:g}"
        words = [f"at least {self.min:g}"] if self.min is not None else []
        return " and ".join([*words, *([f"at most {self.max:g}"] if self.max is not None else [])])


def _exactly(value: Any) -> Any:
    """A number is short for the range from it to itself."""
    if isinstance(value, Mapping | Range):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("should be a number, or {min: number, max: number}")
    return {"min": value, "max": value}


Count = Annotated[Range, BeforeValidator(_exactly)]


class Common(Model):
    """How many blocks from the inception block on these agents' chains share; of one agent: how many it has."""

    agents: Annotated[list[VehicleId], Field(min_length=1)]
    blocks: Count


class Expect(Model):
    """A characteristic that is not named may be anything but violated, and so what is judged beside them.

    `deviations`: in which handler each agent that is wrong first did other than the algorithms say, and nobody else.

    Every seed is played on every backend.
    """

    characteristics: dict[int, CharacteristicVerdict] = {}
    steps: StepsVerdict | None = None
    records: RecordsVerdict | None = None
    liveness: LivenessVerdict | None = None
    figures: dict[FigureName, Count] = {}
    chains: dict[VehicleKey, ChainHash] = {}
    """The top chain hash with which the agent ends: no two chains have the same."""
    common: Annotated[list[Common], Field(max_length=1000)] = []
    deviations: dict[VehicleKey, str] = {}
    backends: Annotated[list[BackendName], Field(min_length=1)] = ["sim"]
    seeds: Annotated[list[Annotated[int, Field(ge=0, strict=True)]], Field(min_length=1, max_length=10_000)] = [1]

    @field_validator("characteristics", mode="before")
    @classmethod
    def _numbered(cls, verdicts: Any) -> Any:
        if not isinstance(verdicts, Mapping):
            return verdicts
        return {_known_number(key): verdict for key, verdict in verdicts.items()}

    @field_validator("figures", mode="before")
    @classmethod
    def _known_figures(cls, figures: Any) -> Any:
        for name in figures if isinstance(figures, Mapping) else ():
            if name not in get_args(FigureName):
                raise ValueError(f"there is no figure {shown(name)}: there are {', '.join(get_args(FigureName))}")
        return figures

    @field_validator("deviations")
    @classmethod
    def _known_handlers(cls, deviations: dict[int, str]) -> dict[int, str]:
        for handler in deviations.values():
            if handler not in HANDLERS:
                near = ", ".join(get_close_matches(handler[:80], HANDLERS, cutoff=0.0))
                raise ValueError(f"there is no handler {shown(handler)}: the nearest are {near}")
        return deviations

    @model_validator(mode="after")
    def _who_deviates_is_found(self) -> "Expect":
        if self.deviations and self.steps not in (None, "deviates"):
            raise ValueError(f"`deviations` need `steps: deviates`, not {self.steps}")
        return self

    @field_validator("backends", "seeds")
    @classmethod
    def _each_once(cls, values: list[Any]) -> list[Any]:
        if len(set(values)) < len(values):
            raise ValueError("names one twice: each is a test of its own")
        return values

    def verdict(self, key: str) -> str | None:
        """What is expected of this characteristic, or judgement beside them; None if nothing is said of it."""
        if key in BESIDE:
            expected: str | None = getattr(self, key)
            if key == "steps" and self.deviations:
                return "deviates"
            return expected
        return self.characteristics.get(NUMBERS.get(key, 0))

    def as_expected(self, key: str, verdict: str) -> bool:
        expected = self.verdict(key)
        return kind_of(verdict) != "bad" if expected is None else verdict == expected

    def out_of_range(self, figures: Mapping[str, float | None]) -> Iterator[str]:
        """A sentence for each figure that is not what it should be."""
        for name, wanted in self.figures.items():
            figure = figures.get(name)
            if figure is None or figure not in wanted:
                shown = "not known" if figure is None else f"{figure:g}"
                yield f"{name.replace('_', ' ')} is {shown}, and should be {wanted.describe()}"

    def other_chains(self, top_chain_hashes: Mapping[int, str]) -> Iterator[str]:
        """A sentence for each agent that ends with another chain; `top_chain_hashes` are those of the exports."""
        for agent_id, wanted in self.chains.items():
            ended = top_chain_hashes.get(agent_id)
            if ended is None:
                yield f"agent {agent_id} has left no chain, and should end with {wanted[:12]} on top"
            elif ended != wanted:
                yield f"agent {agent_id} ends with the chain hash {ended[:12]} on top, and should with {wanted[:12]}"

    def named(self) -> Iterator[tuple[str, int]]:
        """Every agent that is named, with the key that names it."""
        yield from (("chains", agent) for agent in self.chains)
        yield from (("deviations", agent) for agent in self.deviations)
        for index, common in enumerate(self.common):
            yield from ((f"common.{index}.agents", agent) for agent in common.agents)

    def other_common(self, chains: Mapping[int, Sequence[str]]) -> Iterator[str]:
        """A sentence for each chain, or common part of several, that is not as long as it should be."""
        for common in self.common:
            there = all(agent in chains for agent in common.agents)
            levels = zip(*(chains[agent] for agent in common.agents), strict=False) if there else ()
            shared = sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, levels)) if there else None
            if shared is None or shared not in common.blocks:
                whose = f"agent{'s' if len(common.agents) > 1 else ''} {' '.join(map(str, common.agents))}"
                common_to = f"the {'common ' if len(common.agents) > 1 else ''}chain of {whose}"
                yield f"{common_to} {_has(shared)}, and should have {common.blocks.describe()}"

    def other_deviations(self, found: Iterable[tuple[int, str | None]]) -> Iterator[str]:
        """A sentence for each agent that deviates otherwise than it should; `found`: agents and handlers, by time."""
        if not self.deviations:
            return
        first: dict[int, str | None] = {}
        for agent, handler in found:
            first.setdefault(agent, handler)
        for agent in sorted({*first, *self.deviations}):
            if first.get(agent, "") != (wanted := self.deviations.get(agent, "")):
                does = (
                    f"deviates first in {first[agent] or 'no known handler'}" if agent in first else "does not deviate"
                )
                yield f"agent {agent} {does}, and should {f'in {wanted}' if wanted else 'not'}"


def _has(blocks: int | None) -> str:
    return "is not known" if blocks is None else f"has {blocks} block{'' if blocks == 1 else 's'}"
