"""The generated vectors: for each reachable pair of a state and an input the shortest way there, and what must come.

Other settings make other agents. Of theirs only those count that differ from the agent with default settings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

from harness.conformance.reference_model import Outcome
from harness.conformance.state_space import VARIANTS, Pair, Step, Variant, explore, in_short


@dataclass(frozen=True)
class Vectors:
    """Of one variant of the settings: all steps, and those that count."""

    variant: Variant
    steps: Sequence[Step]
    wanted: Mapping[Pair, Step]

    @cached_property
    def by_pair(self) -> dict[Pair, Step]:
        return {step.pair: step for step in self.steps}


def generate(only: str | None = None) -> list[Vectors]:
    """The same at each call. `only`: a number or name of a handler, to whose branches the vectors are limited."""
    if only is None:
        return list(_all())
    return [
        replace(vectors, wanted={pair: step for pair, step in vectors.wanted.items() if is_of(step.outcome, only)})
        for vectors in _all()
    ]


@cache
def _all() -> tuple[Vectors, ...]:
    """Made once, for however many agents: it takes seconds."""
    usual: dict[Pair, tuple[object, ...]] = {}
    generated = []
    for variant in VARIANTS.values():
        steps = list(explore(variant))
        told = {step.pair: in_short(step.outcome) for step in steps}
        wanted = {step.pair: step for step in steps if usual.get(step.pair) != told[step.pair]}
        usual = usual or told
        generated.append(Vectors(variant, steps, wanted))
    return tuple(generated)


def is_of(outcome: Outcome, only: str) -> bool:
    return any(only in (str(run.algorithm), run.handler) for run in outcome.runs)
