"""Identify a finding in a way that does not depend on the run: by the verdict, the handler, and the form of the endless
cycle.
"""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from harness.archive.run_record import Cycle
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.scenario import Scenario
from harness.scenario.verdict_names import CHARACTERISTICS, ENDED
from ucp.agent import ON_TIMER
from ucp.settings import Settings

CAUSED_BY_LIVELOCK = frozenset(("5", "6"))
"""Characteristics that every livelock violates, because agents in a livelock commit no further blocks."""
TIMERS = {ON_TIMER[timer].name: timer for timer in ("voting", "phase one", "phase two", "phase three")}
"""Name of the handler of a timer expiry -> name of the timer."""
ORDER = [*TIMERS.values()]
MAX_FORM = 250
"""Maximum number of characters in the description of a cycle. A longer description is omitted."""
SIZE_SETTINGS = frozenset(("max_block_bytes", "max_event_bytes"))


@dataclass(frozen=True, order=True)
class FindingIdentity:
    """The identity of a finding."""

    key: str
    """The key of the check with a bad verdict."""
    verdict: str
    handler: str = ""
    """The handler that the evidence names. Empty if the evidence names no handler."""
    shape: str = ""

    def __str__(self) -> str:
        name = f"characteristic {self.key}" if self.key in CHARACTERISTICS else self.key
        return ", ".join(part for part in (f"{name} {self.verdict}", self.handler, self.shape) if part)


def identities(result: Result, cycle: Cycle | None, scenario: Scenario) -> tuple[FindingIdentity, ...]:
    """Return the identity of the finding for each bad verdict. An identity also contains the settings that differ from
    the thesis.
    """
    settings = _changed_settings(scenario.settings)
    return tuple(
        FindingIdentity(
            key,
            judgement.verdict,
            next((finding.handler for finding in judgement.evidence if finding.handler), ""),
            ", ".join(part for part in (_shape(key, judgement, result, cycle), settings) if part),
        )
        for key, judgement in ((key, result.judgements[key]) for key in result.wrong)
        if cycle is None or key not in CAUSED_BY_LIVELOCK
    )


def _changed_settings(settings: Settings) -> str:
    default = Settings()
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    changed = {name: value for name, value in values.items() if value != getattr(default, name)}
    return ", ".join(f"{name} {value}" for name, value in changed.items() if name not in SIZE_SETTINGS)


def _shape(key: str, judgement: Judgement, result: Result, cycle: Cycle | None) -> str:
    if key == ENDED:
        return ", ".join(sorted({finding.detail.partition(":")[0] for finding in judgement.evidence}))
    if key == "6":
        holders = sorted(Counter(result.chains.values()).values(), reverse=True)
        return f"chains of {', '.join(map(str, holders))} agents"
    if key != "liveness" or cycle is None:
        return ""
    going = f"{len(cycle.agents)} agent{'s' if len(cycle.agents) > 1 else ''}"
    if cycle.period_s is None:
        return f"{going} standing still"
    form = "; ".join(_form(cycle))
    return f"{going} going round every {cycle.period_s:.0f} s" + (f" ({form})" if len(form) <= MAX_FORM else "")


def _form(cycle: Cycle) -> list[str]:
    """Return the sequences of timers that agents repeat in an endless cycle, without duplicates. The command `prove`
    compares livelocks in the same way.
    """
    patterns = defaultdict[int, list[str]](list)
    for step in cycle.steps:
        if step.handler in TIMERS:
            patterns[step.agent_id].append(TIMERS[step.handler])
    return sorted({", ".join(_one_repetition(pattern)) for pattern in patterns.values()})


def _one_repetition(pattern: Sequence[str]) -> Sequence[str]:
    """Return one period of a repeating sequence of timers. The period starts with the vote timer if it contains one."""
    length = len(pattern)
    divisors = (part for part in range(1, length + 1) if length % part == 0)
    once = next(part for part in divisors if [*pattern[:part]] * (length // part) == pattern)
    rotations = ([*pattern[start:once], *pattern[:start]] for start in range(once))
    return min(rotations, key=lambda rotation: [*map(ORDER.index, rotation)])
