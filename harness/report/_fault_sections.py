"""Show lost blocks, injected messages and remote agents in the report.

- Blocks can be lost together with vehicles.
- The rogue node is a sender outside the swarm. The report shows the datagrams that it sent, and how the agents reacted.
- Remote agents ran on other computers. The report describes their clocks, their connections, and the times when they
  were cut off from the swarm.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from harness.archive.run_record import Loss, RemoteRecord, RogueInjection, RunRecord, Survival
from harness.checker.injections import describe_handling
from harness.checker.injections import in_words as injection_in_words
from harness.checker.survival import in_words
from harness.present import text
from harness.present.colours import AgentColours
from harness.report import facts
from harness.report.chain_tree import ranges


@dataclass(frozen=True, slots=True)
class LostBlockRow:
    """A table row about a block that a lost vehicle completed, or that no vehicle holds any longer."""

    name: str
    ink: AgentColours | None
    holders: str
    holders_at_end: str


@dataclass(frozen=True, slots=True)
class LossRow:
    at: str
    what: str
    vehicles: str
    counts: list[str]
    """Four numbers of blocks. The first two count the blocks that were completed before the loss, and the blocks that
    vehicles still held after it. The last two count the blocks that the loss destroyed, and the blocks that are missing
    at the end of the run.
    """
    blocks: list[LostBlockRow]


@dataclass(frozen=True, slots=True)
class SurvivalSection:
    sentences: list[str]
    losses: list[LossRow]


def survival_section(survived: Survival | None, ink: Mapping[int, AgentColours]) -> SurvivalSection | None:
    """Return the section about lost blocks. Return None if the record contains nothing about the survival of blocks."""
    if survived is None:
        return None
    return SurvivalSection(in_words(survived), [_row(loss, ink) for loss in survived.losses])


def _row(loss: Loss, ink: Mapping[int, AgentColours]) -> LossRow:
    counts = (loss.completed, loss.survived, loss.gone, loss.gone_at_end)
    blocks = [
        LostBlockRow(block.block, ink.get(block.agent_id), _listed(block.holders), _listed(block.holders_at_end))
        for block in loss.blocks
    ]
    return LossRow(
        text.duration(loss.at_s), loss.what, _listed(loss.vehicles), [text.value(count) for count in counts], blocks
    )


def _listed(vehicles: list[int]) -> str:
    return ", ".join(ranges(vehicles)) or "none"


MAX_ROGUE_ROWS = 500


@dataclass(frozen=True, slots=True)
class InjectionRow:
    """A table row about one result of an injection. `message` is the type of the injected message. If the agents
    refused the datagrams, `message` is instead the reason for the refusal.
    """

    at: str
    what: str
    detail: str
    message: str
    sent: str
    done: str
    changed: str


@dataclass(frozen=True, slots=True)
class RogueSection:
    """The table of injected messages. `left_out` is the number of rows that the table omits, because it has at most
    `MAX_ROGUE_ROWS` rows.
    """

    rows: list[InjectionRow]
    left_out: int


def rogue_section(injections: Sequence[RogueInjection]) -> RogueSection | None:
    """Return the table of injected messages. Return None if no message was injected in the run."""
    rows = [row for injection in injections for row in _rogue_rows(injection)]
    return RogueSection(rows[:MAX_ROGUE_ROWS], max(0, len(rows) - MAX_ROGUE_ROWS)) if rows else None


def rogue_sentences(injections: Sequence[RogueInjection]) -> list[str]:
    return [injection_in_words(injection) for injection in injections]


def _rogue_rows(injection: RogueInjection) -> list[InjectionRow]:
    outcomes = [(of.message, of.sent, describe_handling(of), text.value(of.changed)) for of in injection.messages]
    outcomes += [(f"none: {reason}", count, "refused", "\u2013") for reason, count in injection.refused.items()]
    outcomes += (
        [("any", injection.untraced, "indistinguishable from their originals", "\u2013")] if injection.untraced else []
    )
    begun = (text.duration(injection.at_s), injection.what, injection.detail)
    return [
        InjectionRow(*begun, message, text.value(sent), done, changed)
        for message, sent, done, changed in outcomes or [("\u2013", 0, "nothing sent", "\u2013")]
    ]


def remote_sentences(record: RunRecord) -> list[str]:
    """Return sentences about each agent on another computer. Return no sentences if all agents ran on this computer."""
    lines = [*_workers(record)]
    for agent_id, found in record.remote.items():
        if found.worker is not None:
            continue
        where = f"Agent {agent_id} ran on the computer {found.host}"
        if found.offset_s is None or found.uncertainty_s is None or found.delay_s is None:
            lines.append(f"{where}. Its clock was not measured.")
            continue
        slow = "" if found.delay_p95_s is None else f", and in one of twenty times {_ms(found.delay_p95_s)} or more"
        lines.append(
            f"{where}. Its clock was {_ms(abs(found.offset_s))} {'ahead' if found.offset_s >= 0 else 'behind'}, within "
            f"{_ms(found.uncertainty_s)}. Its connection took {_ms(found.delay_s)} of wall time in one direction{slow}."
            " A delay that the scenario asks for contains this time. A link without such a delay has it in addition."
        )
    return lines + [f"{sentence[0].upper()}{sentence[1:]}." for sentence in facts.cut_off(record)]


def _workers(record: RunRecord) -> Iterator[str]:
    """Yield a sentence about each worker (a computer of a cluster) that ran agents."""
    played: dict[str, dict[int, RemoteRecord]] = {}
    for agent_id, found in record.remote.items():
        if found.worker is not None:
            played.setdefault(found.worker, {})[int(agent_id)] = found
    for worker, agents in played.items():
        where = facts.agents_in_words(agents)
        where = f"{where[0].upper()}{where[1:]} ran on the worker {worker}"
        clocks = [(found.uncertainty_s, found.offset_s) for found in agents.values() if found.uncertainty_s is not None]
        delays = [found.delay_s for found in agents.values() if found.delay_s is not None]
        if not clocks or not delays:
            yield f"{where}. Its clock was not measured."
            continue
        uncertainty_s, offset_s = min(clocks)
        yield (
            f"{where}. Its clock was {_ms(abs(offset_s or 0.0))} {'ahead' if (offset_s or 0.0) >= 0 else 'behind'}, "
            f"within {_ms(uncertainty_s)}. The connections of its agents took {_ms(min(delays))} to {_ms(max(delays))} "
            "of wall time in one direction. A delay that the scenario asks for contains this time."
        )


def _ms(seconds: float) -> str:
    return f"{text.value(round(1000 * seconds, 3))} ms"
