"""Play an attack, and report the violated characteristics and the reasons for dropped datagrams."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from docs.generate.threats.rows import CAPTURED, ROWS, Row
from harness.run.simulate import simulate
from harness.scenario.verdict_names import CHARACTERISTICS

SEEDS = (1, 2)
HEADER = "| attacker | attack | 1 | 2 | 3 | 4 | 5 | 6 | dropped because |\n|---|---|:-:|:-:|:-:|:-:|:-:|:-:|---|\n"


OTHERS, ITSELF, NONE = "\u2718", "(\u2718)", "\u00b7"
"""Symbols for the verdict on a characteristic.

OTHERS: other vehicles or the swarm as a whole violate it. ITSELF: only vehicle 3 violates it. NONE: it is not violated.
"""

SWARM = 0
"""The agent ID that stands for the swarm as a whole if a violation names no agent."""


@dataclass(frozen=True)
class Outcome:
    """The symbol for each characteristic, and the reasons for dropped datagrams. The most frequent reason is first."""

    marks: dict[str, str]
    dropped: list[str]


def outcome(row: Row) -> Outcome:
    """Play the attack with each seed, and return the combined result."""
    guilty: dict[str, set[int]] = {key: set() for key in CHARACTERISTICS}
    dropped = Counter[str]()
    for seed in SEEDS:
        run = simulate(row.scenario, seed, tracing=True)
        for key in CHARACTERISTICS:
            judgement = run.result.judgements[key]
            if judgement.verdict == "violated":
                guilty[key].update({finding.agent_id for finding in judgement.evidence} or {SWARM})
        for agent in run.played.agents.values():
            dropped.update(agent.dropped or {})
    marks = {key: NONE if not agents else ITSELF if agents == {CAPTURED} else OTHERS for key, agents in guilty.items()}
    return Outcome(marks, [reason for reason, _ in dropped.most_common()])


def table(rows: Iterable[Row] = ROWS) -> Iterator[str]:
    """Yield the lines of the table in Markdown."""
    yield HEADER
    for row in rows:
        found = outcome(row)
        yield f"| {row.who} | {row.does} | {' | '.join(found.marks.values())} | {', '.join(found.dropped)} |\n"
