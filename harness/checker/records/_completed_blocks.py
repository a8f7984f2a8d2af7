"""What an agent completed: by its trace, by its export, and by the run's record of the lives that left no export."""

from collections.abc import Iterator
from itertools import pairwise

from harness.checker._trace_replay import Life
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from harness.checker.records.contradiction import Contradiction
from ucp.trigger import BootTrigger


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """What an agent completed is the same, in the same order, wherever it is told."""
    for agent_id, lives in evidence.lives.items():
        if evidence.traces[agent_id].problem or any(life.unknown for life in lives):
            continue
        yield from _over_brown_outs(evidence, agent_id, lives)
        traced = dict.fromkeys(block for life in lives for block in life.completed)
        export, recorded = evidence.exports.get(agent_id), evidence.recorded(agent_id)
        exported = export.completed if export else []
        before = recorded.completed_before if recorded else []
        for source, blocks in (("its export", exported), ("run.json", before)):
            untraced = [block for block in blocks if block not in traced]
            if untraced:
                detail = f"{source} says that it completed {_named(evidence, untraced)}, and its trace does not"
                yield _of_block(evidence, agent_id, detail, untraced[0], short=True)
        if recorded is not None and (recorded.outcome == "killed" or (recorded.outcome == "exported" and export)):
            told = {*exported, *before}
            if untold := [block for block in traced if block not in told]:
                detail = f"its trace says that it completed {_named(evidence, untold)}, and its export does not"
                yield _of_block(evidence, agent_id, detail, untold[0])
        if export is not None and _out_of_order(exported, lives[-1].completed):
            detail = "its export names the blocks that it completed in another order than its trace"
            yield _of_block(evidence, agent_id, detail, exported[0])


def _over_brown_outs(evidence: Evidence, agent_id: int, lives: list[Life]) -> Iterator[Contradiction]:
    """What it had completed is found on its disk; it may have been killed over a line that its trace lacks."""
    for before, after in pairwise(lives):
        if not after.runs or not isinstance(after.runs[0].trigger, BootTrigger):
            continue
        restored = [block for operation, block in after.runs[0].changes if operation == "complete"]
        if restored[: len(before.completed)] != before.completed:
            lost = next((block for block in before.completed if block not in restored), before.completed[0])
            detail = f"at {after.runs[0].t:g} s it goes on with other blocks completed than it had when it went down"
            yield _of_block(evidence, agent_id, detail, lost)


def _out_of_order(exported: list[str], traced: list[str]) -> bool:
    """Whether the blocks that both name, as a life goes on, are not in the same order, or not once each."""
    both = {*exported} & {*traced}
    return [block for block in exported if block in both] != [block for block in traced if block in both]


def _of_block(evidence: Evidence, agent_id: int, detail: str, block_hash: str, *, short: bool = False) -> Contradiction:
    return Contradiction(Finding(agent_id, detail, evidence.name(block_hash), block_hash), "5", short)


def _named(evidence: Evidence, blocks: list[str]) -> str:
    if len(blocks) == 1:
        return f"block {evidence.name(blocks[0])}"
    return f"{len(blocks)} blocks, {evidence.name(blocks[0])} the first"
