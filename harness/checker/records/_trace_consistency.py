"""A trace against itself: its changes against its states, its times and its sequence numbers."""

from collections.abc import Iterator

from harness.checker._trace_replay import Life, Sight
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from harness.checker.records.contradiction import Contradiction, slack_s


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """What does not fit in each life of an agent, and from one life to the next."""
    for agent_id, lives in evidence.lives.items():
        for life in lives:
            yield from _in_life(evidence, agent_id, life)
        yield from _between_lives(evidence, agent_id, lives)


def _in_life(evidence: Evidence, agent_id: int, life: Life) -> Iterator[Contradiction]:
    for sights, touches in (
        (life.impossible, "3"),
        (life.otherwise, "3"),
        (life.another_top, "4"),
        (life.flags, None),
        (life.back_in_time, None),
        (life.out_of_sequence, "1"),
    ):
        for sight in sights:
            yield Contradiction(finding(evidence, agent_id, sight), touches)


def finding(evidence: Evidence, agent_id: int, sight: Sight) -> Finding:
    """The sight as evidence, with the block's name for people."""
    block = sight.block_hash
    return Finding(agent_id, f"{sight.where}: {sight.what}", evidence.name(block) if block else None, block)


def _between_lives(evidence: Evidence, agent_id: int, lives: list[Life]) -> Iterator[Contradiction]:
    slack = slack_s(evidence.traces[agent_id])
    now = 0.0
    for life in lives:
        if life.runs and life.runs[0].t < now - slack:
            what = f"a life begins at {life.runs[0].t:g} s, before the one before it has ended, at {now:g} s"
            line, run = next(life.numbered())
            sight = Sight(line, run, what)
            yield Contradiction(finding(evidence, agent_id, sight))
        now = life.runs[-1].t if life.runs else now
