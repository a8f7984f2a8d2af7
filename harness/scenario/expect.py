"""Describe the expected results of a scenario: verdicts, numeric results, chains and deviations. Name the backends and
seeds to which they apply.

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
from harness.present.text import did_you_mean
from harness.scenario.strict_model import StrictModel, VehicleId, VehicleKey
from harness.scenario.verdict_names import (
    CHARACTERISTICS,
    FURTHER_CHECKS,
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
    "collisions",
    "airtime_s",
    "airtime_per_block_s",
    "mutual_chain_before_final_reconcile",
    "distinct_chains_before_final_reconcile",
]
"""Names of the numeric results that `harness.checker._liveness` computes."""

CHARACTERISTIC_NUMBERS = {number: int(number) for number in CHARACTERISTICS}
"""Number of a characteristic as a JSON key -> the same number as an integer."""

AS_EXPECTED = "as expected"
"""The remark on a bad verdict that the scenario expects."""

ChainHash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Number = Annotated[float, Field(allow_inf_nan=False)]


def _known_number(key: Any) -> int:
    number = CHARACTERISTIC_NUMBERS.get(str(key))
    if number is None or isinstance(key, float):
        raise ValueError(f"no characteristic {shown(key)}: use 1 to 6")
    return number


class NumberRange(StrictModel):
    """A range of numbers. Needs `min`, `max`, or both. If the value is a single number, only this number is allowed."""

    min: Number | None = None
    """Lowest allowed value."""
    max: Number | None = None
    """Highest allowed value."""

    @model_validator(mode="after")
    def _check_values(self) -> "NumberRange":
        if self.min is None and self.max is None:
            raise ValueError("needs `min` or `max`")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is more than max {self.max:g}")
        return self

    def __contains__(self, figure: float) -> bool:
        return (self.min is None or figure >= self.min) and (self.max is None or figure <= self.max)

    def describe(self) -> str:
        """Return the range as text, such as "at least 40"."""
        if self.min == self.max:
            return f"{self.min:g}"
        words = [f"at least {self.min:g}"] if self.min is not None else []
        return " and ".join([*words, *([f"at most {self.max:g}"] if self.max is not None else [])])


def _exact_range(value: Any) -> Any:
    """Return a range that contains only this number. A value that is already a range is returned unchanged."""
    if isinstance(value, Mapping | NumberRange):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("should be a number, or {min: number, max: number}")
    return {"min": value, "max": value}


Count = Annotated[NumberRange, BeforeValidator(_exact_range)]


class CommonBlocks(StrictModel):
    """The expected length of the common beginning of several chains, or of the chain of one agent."""

    agents: Annotated[list[VehicleId], Field(min_length=1)]
    """IDs of the agents."""
    blocks: Count
    """Expected number of blocks at the beginning of the chains that are equal in the chains of all these agents."""


class Expect(StrictModel):
    """Expected results. pytest runs a test for each combination of seed and backend.

    A check without an expected verdict passes unless its verdict is bad.
    """

    characteristics: dict[int, CharacteristicVerdict] = {}
    """Expected verdicts on the characteristics of the thesis (Section 4.3), by number 1 to 6."""
    steps: StepsVerdict | None = None
    """Expected verdict of the check that compares every handler run with the reference core."""
    records: RecordsVerdict | None = None
    """Expected verdict of the check that compares records of the same facts."""
    liveness: LivenessVerdict | None = None
    """Expected verdict of the check that tests whether the swarm became idle."""
    figures: dict[FigureName, Count] = {}
    """Expected numeric results of the run, by name. A value is a number or a range."""
    chains: dict[VehicleKey, ChainHash] = {}
    """Expected top chain hash at the end, by agent ID. The top chain hash identifies the whole chain."""
    common: Annotated[list[CommonBlocks], Field(max_length=1000)] = []
    """Expected lengths of chains, or of the common beginnings of chains."""
    deviations: dict[VehicleKey, str] = {}
    """Agent ID -> the handler in which the agent first deviates from the algorithms. Other agents must not deviate. If
    `steps` is given, its value must be `deviates`.
    """
    backends: Annotated[list[BackendName], Field(min_length=1)] = ["sim"]
    """Backends with which pytest runs the scenario. Each backend may occur once."""
    seeds: Annotated[list[Annotated[int, Field(ge=0, strict=True)]], Field(min_length=1, max_length=10_000)] = [1]
    """Seeds with which pytest runs the scenario. Each seed may occur once."""

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
                known = get_args(FigureName)
                raise ValueError(f"no figure {shown(name)}: use one of {', '.join(known)}{did_you_mean(name, known)}")
        return figures

    @field_validator("deviations")
    @classmethod
    def _known_handlers(cls, deviations: dict[int, str]) -> dict[int, str]:
        for handler in deviations.values():
            if handler not in HANDLERS:
                near = ", ".join(get_close_matches(handler[:80], HANDLERS, cutoff=0.0))
                raise ValueError(f"no handler {shown(handler)}: the nearest are {near}")
        return deviations

    @model_validator(mode="after")
    def _deviations_are_expected(self) -> "Expect":
        if self.deviations and self.steps not in (None, "deviates"):
            raise ValueError(f"`deviations` need `steps: deviates`, not {self.steps}")
        return self

    @field_validator("backends", "seeds")
    @classmethod
    def _each_once(cls, values: list[Any]) -> list[Any]:
        if len(set(values)) < len(values):
            raise ValueError("names one expectation twice: leave out one of them")
        return values

    def verdict(self, key: str) -> str | None:
        """Return the expected verdict of a check. Return None if the scenario expects none."""
        if key in FURTHER_CHECKS:
            expected: str | None = getattr(self, key)
            if key == "steps" and self.deviations:
                return "deviates"
            return expected
        return self.characteristics.get(CHARACTERISTIC_NUMBERS.get(key, 0))

    def as_expected(self, key: str, verdict: str) -> bool:
        expected = self.verdict(key)
        return kind_of(verdict) != "bad" if expected is None else verdict == expected

    def remark(self, key: str, verdict: str) -> str:
        """Return the remark on a verdict. If the scenario expects another verdict, the remark names it, such as
        "expected: holds". If the scenario expects this verdict although it is not good, the remark is "as expected".
        Otherwise it is empty.
        """
        expected = self.verdict(key)
        if verdict == expected:
            return AS_EXPECTED if kind_of(verdict) != "good" else ""
        return f"expected: {expected}" if expected else ""

    def in_words(self, key: str, verdict: str) -> str:
        """Return the verdict with its remark, such as "violated, as expected"."""
        return ", ".join(filter(None, (verdict, self.remark(key, verdict))))

    def unmet(
        self,
        figures: Mapping[str, float | None],
        chains: Mapping[int, Sequence[str]],
        top_chain_hashes: Mapping[int, str],
        found: Iterable[tuple[int, str | None]],
    ) -> Iterator[tuple[str, list[str]]]:
        """Yield each kind of expectation other than verdicts, with a sentence for each unmet expectation of this kind.

        `chains` contains the block hashes of each agent's chain, and `top_chain_hashes` contains its top chain hash.
        `found` contains the agent and the handler of each deviation.
        """
        if self.figures:
            yield "expected figures", list(self.out_of_range(figures))
        if self.chains or self.common:
            tops = self.unexpected_chains(top_chain_hashes)
            yield "expected chains", [*tops, *self.unexpected_common_blocks(chains)]
        if self.deviations:
            yield "expected deviations", list(self.unexpected_deviations(found))

    def out_of_range(self, figures: Mapping[str, float | None]) -> Iterator[str]:
        """Yield a sentence for each numeric result that is outside its expected range."""
        for name, wanted in self.figures.items():
            figure = figures.get(name)
            if figure is None or figure not in wanted:
                shown = "not known" if figure is None else f"{figure:g}"
                yield f"{name.replace('_', ' ')} is {shown}, and should be {wanted.describe()}"

    def unexpected_chains(self, top_chain_hashes: Mapping[int, str]) -> Iterator[str]:
        """Yield a sentence for each agent whose chain differs from the expected one."""
        for agent_id, wanted in self.chains.items():
            ended = top_chain_hashes.get(agent_id)
            if ended is None:
                yield f"agent {agent_id} has no chain, but must end with {wanted[:12]} on top"
            elif ended != wanted:
                yield f"agent {agent_id} ends with the chain hash {ended[:12]} on top, but must end with {wanted[:12]}"

    def named_agents(self) -> Iterator[tuple[str, int]]:
        """Yield each agent ID in the expectations, with the key that contains it."""
        yield from (("chains", agent) for agent in self.chains)
        yield from (("deviations", agent) for agent in self.deviations)
        for index, common in enumerate(self.common):
            yield from ((f"common.{index}.agents", agent) for agent in common.agents)

    def unexpected_common_blocks(self, chains: Mapping[int, Sequence[str]]) -> Iterator[str]:
        """Yield a sentence for each chain or common beginning of chains whose length differs from the expected one."""
        for common in self.common:
            there = all(agent in chains for agent in common.agents)
            levels = zip(*(chains[agent] for agent in common.agents), strict=False) if there else ()
            shared = sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, levels)) if there else None
            if shared is None or shared not in common.blocks:
                whose = f"agent{'s' if len(common.agents) > 1 else ''} {' '.join(map(str, common.agents))}"
                common_to = f"the {'common ' if len(common.agents) > 1 else ''}chain of {whose}"
                yield f"{common_to} {_has(shared)}, and should have {common.blocks.describe()}"

    def unexpected_deviations(self, found: Iterable[tuple[int, str | None]]) -> Iterator[str]:
        """Yield a sentence for each agent whose first deviation differs from the expected one. `found` contains the
        agent and the handler of each deviation, in time order.
        """
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
