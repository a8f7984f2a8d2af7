"""What comes of a threat: which characteristics are violated in some run, and why what was sent was not believed."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from docs.generate.threats.rows import CAPTURED, ROWS, Row
from harness.run.simulate import simulate
from harness.scenario.verdict_names import CHARACTERISTICS

SEEDS = (1, 2)
HEADER = "| who | does | 1 | 2 | 3 | 4 | 5 | 6 | dropped as |\n|---|---|:-:|:-:|:-:|:-:|:-:|:-:|---|\n"


OTHERS, ITSELF, NOBODY = "\u2718", "(\u2718)", "\u00b7"
"""Whose record violates a characteristic: that of others or the swarm as a whole, that of vehicle 3 alone, or none."""

SWARM = 0
"""Who violates what no single record shows."""


@dataclass(frozen=True)
class Outcome:
    """`marks` says of each characteristic whose record violates it, `dropped` why datagrams were, the most first."""

    marks: dict[str, str]
    dropped: list[str]


def outcome(row: Row) -> Outcome:
    """That of all seeds together."""
    guilty: dict[str, set[int]] = {key: set() for key in CHARACTERISTICS}
    dropped = Counter[str]()
    for seed in SEEDS:
        run = simulate(row.scenario, seed, tracing=True)
        for key in CHARACTERISTICS:
            judgement = run.result.judgements[key]
            if judgement.verdict == "violated":
                guilty[key].update({finding.agent_id for finding in judgement.evidence} or {SWARM})
        for agent in run.played.agents.values():
            dropped.update(agent.get("dropped", {}))
    marks = {
        key: NOBODY if not agents else ITSELF if agents == {CAPTURED} else OTHERS for key, agents in guilty.items()
    }
    return Outcome(marks, [reason for reason, _ in dropped.most_common()])


def table(rows: Iterable[Row] = ROWS) -> Iterator[str]:
    """The table, line by line, in Markdown."""
    yield HEADER
    for row in rows:
        came = outcome(row)
        yield f"| {row.who} | {row.does} | {' | '.join(came.marks.values())} | {', '.join(came.dropped)} |\n"
