"""What a finding is, whichever run shows it: the verdict, the handler that it names, its shape; never the seed."""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from harness.archive.run_record import Cycle
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.run.simulate import ENDED
from harness.scenario import Scenario
from harness.scenario.verdict_names import CHARACTERISTICS
from ucp.agent import ON_TIMER
from ucp.settings import Settings

FOLLOW_FROM_A_CYCLE = frozenset(("5", "6"))
"""Those who go round for ever commit no more, and their chains stay apart."""
TIMERS = {ON_TIMER[timer].name: timer for timer in ("voting", "phase one", "phase two", "phase three")}
"""Handler that runs when it ends -> the timer."""
ORDER = [*TIMERS.values()]
MOST_FORM = 250
"""A longer form is none that anybody reads."""
OF_SIZE = frozenset(("max_block_bytes", "max_event_bytes"))


@dataclass(frozen=True, order=True)
class Identity:
    """`key` is that of a judgement; `handler` is empty if none of the 20 is named."""

    key: str
    verdict: str
    handler: str = ""
    shape: str = ""

    def __str__(self) -> str:
        name = f"characteristic {self.key}" if self.key in CHARACTERISTICS else self.key
        return ", ".join(part for part in (f"{name} {self.verdict}", self.handler, self.shape) if part)


def identities(result: Result, cycle: Cycle | None, scenario: Scenario) -> tuple[Identity, ...]:
    """Of all that is bad about a run; those with other settings than the thesis's are others."""
    settings = _otherwise(scenario.settings)
    return tuple(
        Identity(
            key,
            judgement.verdict,
            next((finding.handler for finding in judgement.evidence if finding.handler), ""),
            ", ".join(part for part in (_shape(key, judgement, result, cycle), settings) if part),
        )
        for key, judgement in ((key, result.judgements[key]) for key in result.wrong)
        if cycle is None or key not in FOLLOW_FROM_A_CYCLE
    )


def _otherwise(settings: Settings) -> str:
    default = Settings()
    named = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return ", ".join(
        f"{name} {value}" for name, value in named.items() if name not in OF_SIZE and value != getattr(default, name)
    )


def _shape(key: str, judgement: Judgement, result: Result, cycle: Cycle | None) -> str:
    if key == ENDED:
        return " ".join(judgement.reason.split()[2:])
    if key == "6":
        holders = sorted(Counter(result.chains.values()).values(), reverse=True)
        return f"chains of {', '.join(map(str, holders))} agents"
    if key != "liveness" or cycle is None:
        return ""
    going = f"{len(cycle.agents)} agent{'s' if len(cycle.agents) > 1 else ''}"
    if cycle.period_s is None:
        return f"{going} standing still"
    form = "; ".join(_form(cycle))
    return f"{going} going round every {cycle.period_s:.0f} s" + (f" ({form})" if len(form) <= MOST_FORM else "")


def _form(cycle: Cycle) -> list[str]:
    """The timers that end on each agent's way round, in order, of those that go the same way once: as `prove` tells
    ways round apart.
    """
    ways = defaultdict[int, list[str]](list)
    for step in cycle.steps:
        if step.handler in TIMERS:
            ways[step.agent_id].append(TIMERS[step.handler])
    return sorted({", ".join(_once_round(way)) for way in ways.values()})


def _once_round(way: Sequence[str]) -> Sequence[str]:
    """Without repeating itself, and wherever it was entered begun at the same place: with the vote, if there is one."""
    length = len(way)
    once = next(part for part in range(1, length + 1) if length % part == 0 and [*way[:part]] * (length // part) == way)
    return min(
        ([*way[start:once], *way[:start]] for start in range(once)), key=lambda turned: [*map(ORDER.index, turned)]
    )
