"""Simulate and judge a swarm whose agents all have the same deliberate error."""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from docs.generate.wrong_agents.quirky import PROBABILITY
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario
from ucp.quirks import QUIRKS

SCENARIOS = Path(__file__).parents[3] / "scenarios"
MISSIONS = (
    SCENARIOS / "loss_15.yaml",
    SCENARIOS / "loss_25.yaml",
    SCENARIOS / "partition_heal.yaml",
    Path(__file__).parent / "busy.yaml",
)
"""The missions of the trials. Successive seeds play them in turn."""

_MOMENT = re.compile(r"\bt=(\d+(?:\.\d+)?) s")


@dataclass(frozen=True)
class Trial:
    """The bad verdicts of a run.

    Each verdict has the mission second of its earliest evidence, or None if no evidence has a time. `named` is the
    first handler that the check of steps names.
    """

    bad: dict[str, float | None]
    named: str | None


@cache
def mission(seed: int) -> Scenario:
    return load_scenario(MISSIONS[(seed - 1) % len(MISSIONS)])


def play(quirk: str | None, seed: int) -> Trial:
    """Play and judge a run whose agents have this deliberate error. If `quirk` is None, the agents are correct."""
    value = {quirk: PROBABILITY if QUIRKS[quirk].chance else True} if quirk else {}
    return judged(simulate(mission(seed).model_copy(update={"quirks": value}), seed, tracing=True).result)


def judged(result: Result) -> Trial:
    deviations = result.beside["steps"].evidence
    return Trial(
        {key: first_s(result.judgements[key]) for key in result.bad}, deviations[0].handler if deviations else None
    )


def first_s(judgement: Judgement) -> float | None:
    """Return the mission second of the earliest evidence of a judgement, or None if no evidence has a time."""
    moments = [float(moment) for finding in judgement.evidence for moment in _MOMENT.findall(finding.detail)[:1]]
    return min(moments, default=None)
