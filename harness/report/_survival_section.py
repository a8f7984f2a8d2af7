"""What became of the blocks where vehicles were lost, as the page says it."""

from collections.abc import Mapping
from dataclasses import dataclass

from harness.archive.run_record import Loss, Survival
from harness.checker.survival import in_words
from harness.present import text
from harness.present.colours import Ink
from harness.report.chain_tree import ranges


@dataclass(frozen=True, slots=True)
class BlockRow:
    """A block that lost vehicles had completed, or that is gone."""

    name: str
    ink: Ink | None
    holders: str
    holders_at_end: str


@dataclass(frozen=True, slots=True)
class LossRow:
    at: str
    what: str
    vehicles: str
    counts: list[str]
    """Blocks completed by then, that survived, that were gone, and that are gone at the end."""
    blocks: list[BlockRow]


@dataclass(frozen=True, slots=True)
class Section:
    sentences: list[str]
    losses: list[LossRow]


def section(survived: Survival | None, ink: Mapping[int, Ink]) -> Section | None:
    """None if the run's record says nothing of it."""
    if survived is None:
        return None
    return Section(in_words(survived), [_row(loss, ink) for loss in survived.losses])


def _row(loss: Loss, ink: Mapping[int, Ink]) -> LossRow:
    counts = (loss.completed, loss.survived, loss.gone, loss.gone_at_end)
    blocks = [
        BlockRow(block.block, ink.get(block.agent_id), _listed(block.holders), _listed(block.holders_at_end))
        for block in loss.blocks
    ]
    return LossRow(
        text.duration(loss.at_s), loss.what, _listed(loss.vehicles), [text.value(count) for count in counts], blocks
    )


def _listed(vehicles: list[int]) -> str:
    return ", ".join(ranges(vehicles)) or "none"
