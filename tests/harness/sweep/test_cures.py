"""Play the scenario of each cell of the table of protocol corrections in docs/appendix/livelock-measurements.md."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.run.simulate import simulate
from harness.scenario import Scenario
from tests.harness.scenario.test_scenarios import SCENARIOS

PAGE = Path(__file__).parents[3] / "docs/appendix/livelock-measurements.md"
SEED = 1
SIZES = range(4, 9)
"""Numbers of agents of swarms in which all other agents refuse one agent's blocks."""


def rows() -> list[tuple[str, list[str]]]:
    """Return each correction with the other cells of its table row."""
    table = PAGE.read_text(encoding="utf-8").partition("<!-- cures: begin -->\n")[2].partition("<!-- cures: end -->")[0]
    cells = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in table.splitlines()[2:]]
    return [(cure, played) for cure, *played in cells]


def refused(agents: int, *, partition: bool) -> dict[str, Any]:
    """Return a scenario in which some agents commit blocks that the other agents miss. Agent 1 then completes a
    block.
    """
    alone = range(2, 2 + (agents + 1) // 2)
    heals_s = 20.0 * len(alone) + 16
    script = [{"at_s": 20.0 * place + 1, "agent": agent} for place, agent in enumerate(alone)]
    document: dict[str, Any] = {
        "name": "refused",
        "agents": agents,
        "duration_s": heals_s + 85,
        "network": {"delay": 0.02},
        "settings": {"max_block_bytes": 267},
        "events": {"source": "scripted", "script": [*script, {"at_s": heals_s + 5, "agent": 1}]},
    }
    if partition:
        others = [agent for agent in range(1, agents + 1) if agent not in alone]
        parted = {"at_s": 0.5, "partition": [others, *([agent] for agent in alone)]}
        return document | {"timeline": [parted, {"at_s": heals_s, "heal": True}]}
    return document | {
        "fates": [{"message": "Commit Block", "sender": agent, "count": 1, "drop": True} for agent in alone]
    }


def outcome(document: dict[str, Any], cure: str) -> str:
    """Return the result of a run in the words of the page.

    This is "round" for an endless cycle, and otherwise the number of different chains of the idle agents.
    """
    document = {key: value for key, value in document.items() if key not in ("expect", "about", "stagger")}
    for part in cure.split("`")[1::2]:
        for key, value in yaml.safe_load(part).items():
            document[key] = document.get(key, {}) | value
    run = simulate(Scenario.model_validate(document), SEED)
    return str(len({*run.result.chains.values()})) if run.played.settled else "round"


def in_short(outcomes: list[str]) -> str:
    """Return the common result if all results are the same. Otherwise, return all results."""
    return outcomes[0] if len({*outcomes}) == 1 else ", ".join(outcomes)


@pytest.mark.any_user
@pytest.mark.parametrize(("cure", "cells"), rows(), ids=[cure.replace("`", "") for cure, _ in rows()])
def test_cure_ends_the_livelocks_that_the_page_names(cure: str, cells: list[str]) -> None:
    played = [
        outcome(yaml.safe_load((SCENARIOS / f"{name}.yaml").read_text()), cure)
        for name in ("in_step", "refused_by_the_third", "by_turns", "drawn_in", "in_resonance", "two_losses")
    ]
    played += [
        in_short([outcome(refused(agents, partition=partition), cure) for agents in SIZES])
        for partition in (False, True)
    ]
    assert played == cells


def test_all_cures_together_end_every_livelock() -> None:
    assert [cells for cure, cells in rows() if "top_needs_majority" in cure and "stagger" in cure]
    assert not [
        cure
        for cure, cells in rows()
        if "top_needs_majority" in cure and "stagger" in cure and any("round" in cell for cell in cells)
    ]
