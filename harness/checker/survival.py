"""Decide which blocks survive when vehicles are lost (thesis, Chapter 1 and Section 3.3).

A block survives if any remaining vehicle holds it, in the chain, in the deque or on the reconcile stack. Traces show
which blocks each vehicle held at the time of a loss. Exports show the blocks at the end.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping

from harness.archive.exports import Export
from harness.archive.run_record import BlockHolders, FaultRecord, LeastHeld, Loss, Survival
from harness.archive.traces import HeldBlocks, Trace
from harness.checker.evidence import Evidence
from harness.checker.judgement import agents

MAX_SENTENCES = 5


def survival(evidence: Evidence) -> Survival:
    """Return the blocks that were lost together with vehicles, and the smallest number of further vehicles whose loss
    would destroy a block.
    """
    at_end = _holders(evidence.exports)
    completed = None if evidence.agents_with_unknown_completed() else evidence.completed_blocks()
    lost = [fault for fault in (evidence.record.faults if evidence.record else ()) if fault.loses_data]
    return Survival(
        losses=_losses(evidence, lost, at_end),
        completed=None if completed is None else len(completed),
        gone=None if completed is None else len(completed.keys() - at_end.keys()),
        at_end=_least_held(evidence, evidence.exports),
        before_final_reconcile=_least_held(evidence, evidence.before_final_reconcile),
    )


def _holders(exports: Mapping[int, Export]) -> dict[str, list[int]]:
    """Block hash -> the vehicles that hold the block in their chain, deque or reconcile stack."""
    holders: dict[str, list[int]] = {}
    for agent_id, export in sorted(exports.items()):
        for block_hash in dict.fromkeys(block.block_hash for block in export.blocks()):
            holders.setdefault(block_hash, []).append(agent_id)
    return holders


def _least_held(evidence: Evidence, exports: Mapping[int, Export]) -> LeastHeld | None:
    """Return the block that the fewest vehicles hold. If there are several such blocks, return the oldest one. Return
    None if no vehicle holds a block.
    """
    holders = _holders(exports)
    if not holders:
        return None
    fewest = min(map(len, holders.values()))
    blocks = {block.block_hash: block for export in exports.values() for block in export.blocks()}
    few = [blocks[block_hash] for block_hash, held_by in holders.items() if len(held_by) == fewest]
    oldest = min(few, key=lambda block: (block.timestamp_us, block.block_hash))
    return LeastHeld(
        vehicles=len(exports),
        holders=holders[oldest.block_hash],
        block=evidence.name(oldest.block_hash),
        block_hash=oldest.block_hash,
        blocks=len(few),
        of=len(holders),
    )


def _losses(evidence: Evidence, lost: list[FaultRecord], at_end: Mapping[str, list[int]]) -> list[Loss]:
    incomplete = [trace for trace in evidence.traces.values() if trace.problem]
    if incomplete or evidence.describe_unknown_name("operation") or set(evidence.roster or ()) - set(evidence.traces):
        return [Loss(at_s=fault.at_s, what=fault.what, vehicles=fault.agents or []) for fault in lost]
    instants = [fault.at_s for fault in lost]
    held = {
        agent_id: _held_at(trace, instants, [fault.at_s for fault in lost if agent_id in (fault.agents or ())])
        for agent_id, trace in sorted(evidence.traces.items())
    }
    completed = {
        block_hash: (run.t, agent_id)
        for agent_id, trace in evidence.traces.items()
        for run in reversed(trace.runs)
        for operation, block_hash in run.changes
        if operation == "complete"
    }
    losses = []
    for number, fault in enumerate(lost):
        vehicles = fault.agents or []
        by_then = {block: agent_id for block, (at_s, agent_id) in completed.items() if at_s <= fault.at_s}
        left = {agent_id: then[number] for agent_id, then in held.items() if agent_id not in vehicles}
        survived = by_then.keys() & set().union(*left.values())
        gone = (by_then.keys() & set().union(*(held[agent_id][number] for agent_id in vehicles))) - survived
        blocks = [block for block, agent_id in by_then.items() if block in gone or agent_id in vehicles]
        losses.append(
            Loss(
                at_s=fault.at_s,
                what=fault.what,
                vehicles=vehicles,
                completed=len(by_then),
                survived=len(survived),
                gone=len(gone),
                gone_at_end=len(by_then.keys() - at_end.keys()),
                blocks=[
                    BlockHolders(
                        block=evidence.name(block),
                        block_hash=block,
                        agent_id=by_then[block],
                        holders=[agent_id for agent_id, then in left.items() if block in then],
                        holders_at_end=at_end.get(block, []),
                    )
                    for block in sorted(blocks, key=lambda block: completed[block])
                ],
            )
        )
    return losses


def _held_at(trace: Trace, instants: Iterable[float], lost_at: Iterable[float]) -> list[set[str]]:
    """Return the blocks that an agent held just before each of these times. If the agent was lost earlier and has not
    restarted, the set is empty.
    """
    waiting, blocks_held = deque(instants), []
    held, at_s = HeldBlocks(), -math.inf

    def record_held() -> None:
        instant = waiting.popleft()
        gone = any(at_s <= loss < instant for loss in lost_at)
        blocks_held.append(set() if gone else {block for block, copies in held.copies.items() if copies})

    for life in trace.incarnations():
        new = HeldBlocks()
        for _, run in life:
            while waiting and waiting[0] < run.t:
                record_held()
            held, at_s = new, run.t
            held.replay(run)
    while waiting:
        record_held()
    return blocks_held


def in_words(survived: Survival) -> list[str]:
    """Describe in sentences the first losses of vehicles, the blocks at the end of the run, and the smallest further
    loss that would destroy a block.
    """
    sentences = [_loss_in_words(loss) for loss in survived.losses[:MAX_SENTENCES]]
    if len(survived.losses) > MAX_SENTENCES:
        sentences.append(f"{len(survived.losses) - MAX_SENTENCES} more losses of vehicles are in run.json")
    if survived.losses and survived.gone is not None and survived.completed is not None:
        sentences.append(f"at the end {_of(survived.gone, survived.completed)} {_is_or_are(survived.gone)} gone")
    elif survived.losses:
        sentences.append("at the end the number of lost completed blocks is unknown")
    if survived.before_final_reconcile is not None:
        sentences.append(f"before the final reconcile {_least_held_in_words(survived.before_final_reconcile)}")
    if survived.at_end is not None:
        sentences.append(_least_held_in_words(survived.at_end))
    return sentences


def _loss_in_words(loss: Loss) -> str:
    alone = len(loss.vehicles) == 1
    sentence = f"at {loss.at_s:.0f} s {_vehicles(loss.vehicles)} {'was' if alone else 'were'} lost ({loss.what})"
    if loss.completed is None or loss.gone is None:
        return f"{sentence}; the traces do not show which blocks were lost"
    return f"{sentence}, and with {'it' if alone else 'them'} {_of(loss.gone, loss.completed)}"


def _least_held_in_words(least: LeastHeld) -> str:
    if len(least.holders) == least.vehicles:
        what = "the block is" if least.of == 1 else f"all {least.of} blocks are"
        return f"{what} on all {least.vehicles} vehicles"
    also = f", and {least.blocks} of {least.of} blocks are on as few vehicles" if least.blocks > 1 else ""
    losing = f"losing {_vehicles(least.holders)} would lose block {least.block}{also}"
    bearable = len(least.holders) - 1
    if not bearable:
        return losing
    return f"losing any {'one vehicle' if bearable == 1 else f'{bearable} vehicles'} loses no block; {losing}"


def _vehicles(vehicles: list[int]) -> str:
    return agents(vehicles).replace("agent", "vehicle")


def _of(blocks: int, completed: int) -> str:
    return f"{blocks or 'none'} of {completed} completed blocks"


def _is_or_are(count: int) -> str:
    return "are" if count > 1 else "is"
