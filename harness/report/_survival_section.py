"""Show in the report which blocks were lost together with vehicles."""

from collections.abc import Mapping
from dataclasses import dataclass

from harness.archive.run_record import Loss, Survival
from harness.checker.survival import in_words
from harness.present import text
from harness.present.colours import AgentColours
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


def section(survived: Survival | None, ink: Mapping[int, AgentColours]) -> SurvivalSection | None:
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
