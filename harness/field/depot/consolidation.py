"""Merge the exports of a mission into one ordered record. The record lists each block once with its holders, and the
missing blocks.

Blocks have the order that `harness.field.depot.record_lines` defines. They are followed by the unfinished blocks that
agents had when they exported their chains. If a completed block begins with the events of an unfinished block, both are
the same block at different times, and only the completed one is listed. Therefore each event of each chain, deque,
reconcile stack or current block occurs exactly once.
"""

import base64
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.archive.exports import Export, ExportedBlock, name_blocks
from harness.field.depot.collected_exports import CollectedExports, all_blocks
from harness.field.depot.record_lines import (
    Block,
    ExportUsed,
    Fork,
    ForkBranch,
    Header,
    Holding,
    MissingItem,
    Place,
    mutual_chain,
    ordered,
)
from harness.gc_pause import gc_paused
from harness.report.chain_tree import ranges
from harness.report.logbook import EventData, SealedError
from ucp.events import EVENT_FIELDS, EVENT_HEADER_BYTES, LoggableEvent
from ucp.wire import struct_of

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot

UNFINISHED = "unfinished"
_HEADER = struct_of(EVENT_FIELDS)


@dataclass(frozen=True)
class RecordedBlock:
    """A block of the merged record. The object decodes the events of the block only when they are needed."""

    line: Block
    event_data: bytes

    @property
    def events(self) -> list[LoggableEvent]:
        return [
            LoggableEvent(timestamp_us, event_id, self.event_data[begin:end])
            for timestamp_us, event_id, begin, end in events_in(self.event_data)
        ]


@dataclass
class MergedRecord:
    """The merged record of a mission. `names` contains the names of all blocks by hash."""

    collected: CollectedExports
    header: Header
    forks: list[Fork]
    blocks: list[RecordedBlock]
    lost: list[MissingItem]
    names: dict[str, str]

    @property
    def lost_blocks(self) -> list[MissingItem]:
        return [lost for lost in self.lost if lost.block is not None]

    @property
    def missing(self) -> list[MissingItem]:
        """The vehicles from which no chain export was collected."""
        return [lost for lost in self.lost if lost.block is None]

    @property
    def unfinished(self) -> list[RecordedBlock]:
        """The blocks that agents had not completed when they exported their chains."""
        return [block for block in self.blocks if block.line.block_hash is None]


@gc_paused()
def consolidate(collected: CollectedExports, depot: "Depot | None" = None) -> MergedRecord:
    """Merge the exports of a mission into one record, and return this record. `depot` decrypts event data. Raises
    ExportError if the key in `depot` does not belong to the mission.
    """
    event_data = EventData.of(collected.exports.values(), depot)
    blocks = all_blocks(collected.read_exports)
    chains = {agent_id: export.chain_of_block_hashes for agent_id, export in collected.exports.items()}
    names = _names(collected)
    mutual = set(mutual_chain(chains.values()))
    holdings, claims = _holdings(collected), collected.claims
    recorded_blocks = []
    for number, block_hash in enumerate(ordered(blocks, [*chains.values()]), 1):
        block = blocks[block_hash]
        data, sealed = _event_data(block, event_data)
        events = [] if sealed else events_in(data)
        line = Block(
            number=number,
            name=names[block_hash],
            agent_id=block.agent_id,
            timestamp_us=block.timestamp_us,
            block_hash=block_hash,
            events=len(events),
            mutual=block_hash in mutual,
            held=holdings[block_hash],
            claimed_hash=claims.get(block_hash),
            unreadable=_unreadable(data, events),
            sealed=sealed,
        )
        recorded_blocks.append(RecordedBlock(line, b"" if sealed else data))
    _add_unfinished(recorded_blocks, collected)
    completed_by = Counter(block.agent_id for block in blocks.values())
    roster = sorted(
        {*collected.roster, *completed_by, *(read_export.export.agent_id for read_export in collected.read_exports)}
    )
    without_export = [agent_id for agent_id in roster if agent_id not in collected.latest]
    lost = _lost_blocks(collected, blocks, names, without_export)
    return MergedRecord(
        collected,
        _header(collected, roster, recorded_blocks, len(mutual), len(lost)),
        _forks(chains, names),
        recorded_blocks,
        [*lost, *(_missing(agent_id, completed_by[agent_id]) for agent_id in without_export)],
        names,
    )


def _header(
    collected: CollectedExports, roster: list[int], blocks: list[RecordedBlock], mutual: int, lost: int
) -> Header:
    return Header(
        inception=collected.inception,
        roster=roster,
        exports=[
            ExportUsed(
                agent_id=export.agent_id,
                file=_without_surrogates(str(read_export.path)),
                exported_at_us=export.exported_at_us,
                latest=collected.latest[export.agent_id] is read_export,
                chain=len(export.chain),
                deque=len(export.blocks_to_be_committed),
                stack=len(export.reconcile_stack),
                completed=len(export.completed),
                idle=export.idle,
                reconcile_in_progress=export.reconcile_in_progress,
                top_chain_hash=export.top_chain_hash,
            )
            for read_export in collected.read_exports
            for export in (read_export.export,)
        ],
        blocks=len(blocks),
        events=sum(block.line.events for block in blocks),
        mutual_chain=mutual,
        longest_chain=max(len(export.chain) for export in collected.exports.values()),
        distinct_chains=len({export.top_chain_hash for export in collected.exports.values()}),
        lost_blocks=lost,
        problems=[*map(_without_surrogates, collected.problems)],
        left_out=[*map(_without_surrogates, collected.left_out)],
        remarks=[*map(_without_surrogates, collected.remarks)],
    )


def _without_surrogates(text: str) -> str:
    """Return a file name as valid text. Bytes that are not valid text become question marks."""
    return text.encode(errors="replace").decode()


def _event_data(block: ExportedBlock, event_data: EventData) -> tuple[bytes, bool]:
    """Return the event data of a block, decrypted if possible, and whether they are still encrypted."""
    try:
        return event_data.of_block(block), False
    except SealedError:
        return block.event_bytes, True


def events_in(event_data: bytes) -> list[tuple[int, int, int, int]]:
    """Return the events in the event data, up to the first unreadable event. Each event has its timestamp, its ID, and
    the start and end positions of its data.
    """
    events, offset = [], 0
    last_header = len(event_data) - EVENT_HEADER_BYTES
    while offset <= last_header:
        timestamp_us, event_id, length = _HEADER.unpack_from(event_data, offset)
        begin = offset + EVENT_HEADER_BYTES
        offset = begin + length
        if offset > len(event_data) or not 1 <= event_id <= 254:
            break
        events.append((timestamp_us, event_id, begin, offset))
    return events


def _unreadable(event_data: bytes, events: Sequence[tuple[int, int, int, int]]) -> str:
    return base64.b64encode(event_data[events[-1][3] if events else 0 :]).decode("ascii")


def _names(collected: CollectedExports) -> dict[str, str]:
    """Return the name of each block, by block hash. If a file contains an edited block, the name of the edited block is
    the name of the original block, followed by "(edited)".
    """
    claims = collected.claims
    exports: dict[int, Export] = {}
    for agent_id, export in collected.exports.items():
        earlier = [each.export for each in collected.earlier if each.export.agent_id == agent_id]
        exports[agent_id] = export.model_copy(
            update={
                "completed": list(dict.fromkeys(block for each in (*earlier, export) for block in each.completed)),
                "chain": [
                    block for each in (*earlier, export) for block in each.blocks() if block.block_hash not in claims
                ],
                "blocks_to_be_committed": [],
                "reconcile_stack": [],
            }
        )
    for agent_id, completed in collected.traced.items():
        traced = Export.model_construct(
            agent_id=agent_id, completed=completed, chain=[], blocks_to_be_committed=[], reconcile_stack=[]
        )
        known = exports.get(agent_id, traced)
        exports[agent_id] = known.model_copy(update={"completed": list(dict.fromkeys([*completed, *known.completed]))})
    names = name_blocks(exports)
    edited = {true: f"{names.get(claimed, claimed[:12])} (edited)" for true, claimed in claims.items()}
    return {**edited, **names}


def _holdings(collected: CollectedExports) -> dict[str, list[Holding]]:
    """Return a mapping from each block hash to its holdings. A holding is a place, such as a position in a chain, with
    the IDs of the agents that hold the block there.
    """
    where: dict[str, dict[tuple[Place, int | None, str | None], list[int]]] = defaultdict(lambda: defaultdict(list))
    for agent_id, export in collected.exports.items():
        for position, block in enumerate(export.chain, 1):
            where[block.block_hash]["chain", position, block.chain_hash].append(agent_id)
        for position, block in enumerate(export.blocks_to_be_committed, 1):
            where[block.block_hash]["deque", position, None].append(agent_id)
        for position, block in enumerate(export.reconcile_stack, 1):
            where[block.block_hash]["stack", position, None].append(agent_id)
    for read_export in collected.earlier:
        for block_hash in read_export.blocks():
            agents = where[block_hash]["earlier export", None, None]
            if read_export.export.agent_id not in agents:
                agents.append(read_export.export.agent_id)
    return {
        block_hash: [
            Holding(place=place, position=position, chain_hash=chain_hash, agents=sorted(agents))
            for (place, position, chain_hash), agents in places.items()
        ]
        for block_hash, places in where.items()
    }


def _add_unfinished(recorded_blocks: list[RecordedBlock], collected: CollectedExports) -> None:
    """Add the unfinished block of each export to the record. If a recorded block begins with the same events, both are
    the same block. In this case, only the holders of the unfinished block are added.
    """
    building = [
        (base64.b64decode(export.current_block.event_data), export)
        for export in (read_export.export for read_export in collected.read_exports)
        if export.current_block.event_data
    ]
    builders = {export.agent_id for _, export in building}
    own_blocks = [block for block in recorded_blocks if block.line.agent_id in builders]
    for data, export in sorted(building, key=lambda each: (-len(each[0]), each[1].agent_id)):
        agent_id = export.agent_id
        matching_block = next(
            (each for each in own_blocks if each.line.agent_id == agent_id and each.event_data.startswith(data)), None
        )
        if matching_block is None:
            events = events_in(data)
            line = Block(
                number=len(recorded_blocks) + 1,
                name=f"{agent_id}.{UNFINISHED}",
                agent_id=agent_id,
                timestamp_us=events[-1][0] if events else export.exported_at_us,
                block_hash=None,
                events=len(events),
                mutual=False,
                held=[],
                unreadable=_unreadable(data, events),
            )
            matching_block = RecordedBlock(line, data)
            recorded_blocks.append(matching_block)
            own_blocks.append(matching_block)
        holding = Holding(place="current block", position=None, chain_hash=None, agents=[agent_id])
        if holding not in matching_block.line.held:
            matching_block.line.held.append(holding)


def _forks(chains: Mapping[int, Sequence[str]], names: Mapping[str, str]) -> list[Fork]:
    """Return the places at which chains diverge. The place nearest to the inception block is first."""
    forks = []
    to_split = [(0, sorted(chains))]
    while to_split:
        height, agents = to_split.pop()
        branches: dict[str | None, list[int]] = {}
        while True:
            branches = {}
            for agent_id in agents:
                chain = chains[agent_id]
                branches.setdefault(chain[height] if height < len(chain) else None, []).append(agent_id)
            if len(branches) > 1 or None in branches:
                break
            height += 1
        if len(branches) == 1:
            continue
        last = chains[agents[0]][height - 1] if height else None
        fork_branches = [
            ForkBranch(agents=branch_agents, next=names[block] if block else None, next_hash=block)
            for block, branch_agents in branches.items()
        ]
        forks.append(Fork(height=height, after=names[last] if last else None, after_hash=last, ways=fork_branches))
        to_split += [
            (height + 1, branch_agents)
            for block, branch_agents in branches.items()
            if block is not None and len(branch_agents) > 1
        ]
    return sorted(forks, key=lambda fork: (fork.height, fork.ways[0].agents))


def _lost_blocks(
    collected: CollectedExports,
    blocks: Mapping[str, ExportedBlock],
    names: Mapping[str, str],
    without_export: Sequence[int],
) -> list[MissingItem]:
    """Return the completed blocks that are lost: no export contains them."""
    lost: dict[str, MissingItem] = {}
    edited = {*collected.claims.values()}
    for read_export in collected.read_exports:
        agent_id = read_export.export.agent_id
        for block_hash in read_export.export.completed:
            if block_hash in blocks or block_hash in lost:
                continue
            why = f"agent {agent_id} completed it, but its export does not contain it"
            if without_export:
                why += f"; vehicles without an export may have it: {', '.join(ranges([*without_export]))}"
            if block_hash in edited:
                why += "; a file has other data under its hash"
            lost[block_hash] = MissingItem(
                agent_id=agent_id,
                block=names[block_hash],
                block_hash=block_hash,
                agents=[*without_export] or [agent_id],
                why=why,
            )
    for agent_id, completed in collected.traced.items():
        for block_hash in completed:
            if block_hash not in blocks and block_hash not in lost:
                why = f"agent {agent_id} completed it according to its trace, but no export contains it"
                lost[block_hash] = MissingItem(
                    agent_id=agent_id, block=names[block_hash], block_hash=block_hash, agents=[agent_id], why=why
                )
    return [*lost.values()]


def _missing(agent_id: int, blocks: int) -> MissingItem:
    others = {0: "no export has blocks of it", 1: "other exports have 1 block of it"}.get(
        blocks, f"other exports have {blocks} of its blocks"
    )
    why = f"vehicle {agent_id} has no export: {others}; its other logged events are missing"
    return MissingItem(agent_id=agent_id, agents=[agent_id], why=why)
