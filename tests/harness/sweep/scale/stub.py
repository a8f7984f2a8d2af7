"""A judge that needs no simulation: figures that follow known laws."""

from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.play.mission import RunOutcome
from harness.scenario import Scenario
from harness.sweep.scale import Scale


def scale(
    *,
    agents: tuple[int, ...] = (5, 10, 40),
    minutes: tuple[float, ...] = (10, 20),
    loss: tuple[float, ...] = (0.15,),
    seeds: int = 2,
) -> Scale:
    return Scale(agents=list(agents), minutes=list(minutes), loss=list(loss), seeds=seeds)


def judge(scenario: Scenario, seed: int) -> tuple[RunOutcome, Result]:
    """Each agent completes a block in 200 s; 3 N^1.5 B messages, none without loss; 40 agents never settle."""
    agents, loss = len(scenario.roster), scenario.network.loss
    blocks = round(agents * scenario.duration_s / 200)
    messages = round(3 * agents**1.5 * blocks) if loss else 0
    figures: dict[str, float | int | None] = {
        "agents": agents,
        "blocks": blocks,
        "mutual_chain": blocks,
        "longest_chain": blocks,
        "distinct_chains": 1 if seed == 1 else 2,
        "uniform_at_s": scenario.duration_s + agents if seed == 1 else None,
        "reconciles": 0,
        "messages": messages,
        "bytes": 100 * messages,
        "messages_per_block": messages / blocks,
    }
    played = RunOutcome(mission_s=scenario.duration_s + 100, settled=agents < 40)
    return played, Result({"3": Judgement("3", "holds", "")}, figures)
