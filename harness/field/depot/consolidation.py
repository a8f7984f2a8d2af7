"""One ordered record of all that came home: each block once, with where it is held, and what is missing.

Blocks stand in the order of `harness.field.depot.record_lines`. A block that an agent was building when it exported
comes after
them, unless a completed block begins with the same events: then it is that block, on its way. So every event of every
block in any chain, deque, reconcile stack or current block is on record exactly once.
"""

import base64
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.archive.event_data import EventData, SealedError
from harness.archive.exports import Export, ExportedBlock, name_blocks
from harness.field.depot.collected_exports import CameHome, all_blocks
from harness.field.depot.record_lines import (
    Block,
    ExportUsed,
    Fork,
    Header,
    Held,
    Lost,
    Place,
    Way,
    mutual_chain,
    ordered,
)
from harness.gc_pause import gc_paused
from harness.report.chain_tree import ranges
from ucp.events import EVENT_FIELDS, EVENT_HEADER_BYTES, LoggableEvent
from ucp.wire import struct_of

if TYPE_CHECKING:
    from ucp.secure.sealing import Depot

UNFINISHED = "unfinished"
_HEADER = struct_of(EVENT_FIELDS)


@dataclass(frozen=True)
class BlockOnRecord:
    """A block as the record has it, with the event data of which its events are made when somebody asks."""

    line: Block
    event_data: bytes

    @property
    def events(self) -> list[LoggableEvent]:
        return [
            LoggableEvent(timestamp_us, event_id, self.event_data[begin:end])
            for timestamp_us, event_id, begin, end in events_in(self.event_data)
        ]


@dataclass
class Consolidation:
    """What came home as one record; `names` are those of all blocks, by hash."""

    home: CameHome
    header: Header
    forks: list[Fork]
    blocks: list[BlockOnRecord]
    lost: list[Lost]
    names: dict[str, str]

    @property
    def lost_blocks(self) -> list[Lost]:
        return [lost for lost in self.lost if lost.block is not None]

    @property
    def missing(self) -> list[Lost]:
        """The vehicles that did not come home."""
        return [lost for lost in self.lost if lost.block is None]

    @property
    def unfinished(self) -> list[BlockOnRecord]:
        """What was being built."""
        return [block for block in self.blocks if block.line.block_hash is None]


@gc_paused()
def consolidate(home: CameHome, depot: "Depot | None" = None) -> Consolidation:
    """The record of what came home; `depot` opens what is sealed. Raises ExportError if that is nothing here."""
    event_data = EventData.of(home.exports.values(), depot)
    blocks = all_blocks(home.brought)
    chains = {agent_id: export.chain_of_block_hashes for agent_id, export in home.exports.items()}
    names = _names(home)
    mutual = set(mutual_chain(chains.values()))
    held, claims = _held(home), home.claims
    on_record = []
    for number, block_hash in enumerate(ordered(blocks, [*chains.values()]), 1):
        block = blocks[block_hash]
        data, sealed = _opened(block, event_data)
        events = [] if sealed else events_in(data)
        line = Block(
            number=number,
            name=names[block_hash],
            agent_id=block.agent_id,
            timestamp_us=block.timestamp_us,
            block_hash=block_hash,
            events=len(events),
            mutual=block_hash in mutual,
            held=held[block_hash],
            claimed_hash=claims.get(block_hash),
            unreadable=_unreadable(data, events),
            sealed=sealed,
        )
        on_record.append(BlockOnRecord(line, b"" if sealed else data))
    _add_unfinished(on_record, home)
    made = Counter(block.agent_id for block in blocks.values())
    flown = sorted({*home.roster, *made, *(brought.export.agent_id for brought in home.brought)})
    absent = [agent_id for agent_id in flown if agent_id not in home.latest]
    lost = _lost_blocks(home, blocks, names, absent)
    return Consolidation(
        home,
        _header(home, flown, on_record, len(mutual), len(lost)),
        _forks(chains, names),
        on_record,
        [*lost, *(_missing(agent_id, made[agent_id]) for agent_id in absent)],
        names,
    )


def _header(home: CameHome, flown: list[int], blocks: list[BlockOnRecord], mutual: int, lost: int) -> Header:
    return Header(
        inception=home.inception,
        roster=flown,
        exports=[
            ExportUsed(
                agent_id=export.agent_id,
                file=_writable(str(brought.path)),
                exported_at_us=export.exported_at_us,
                latest=home.latest[export.agent_id] is brought,
                chain=len(export.chain),
                deque=len(export.blocks_to_be_committed),
                stack=len(export.reconcile_stack),
                completed=len(export.completed),
                idle=export.idle,
                reconcile_in_progress=export.reconcile_in_progress,
                top_chain_hash=export.top_chain_hash,
            )
            for brought in home.brought
            for export in (brought.export,)
        ],
        blocks=len(blocks),
        events=sum(block.line.events for block in blocks),
        mutual_chain=mutual,
        longest_chain=max(len(export.chain) for export in home.exports.values()),
        distinct_chains=len({export.top_chain_hash for export in home.exports.values()}),
        lost_blocks=lost,
        problems=[*map(_writable, home.problems)],
        left_out=[*map(_writable, home.left_out)],
        remarks=[*map(_writable, home.remarks)],
    )


def _writable(text: str) -> str:
    """A file's name may have bytes that are no text: question marks instead."""
    return text.encode(errors="replace").decode()


def _opened(block: ExportedBlock, event_data: EventData) -> tuple[bytes, bool]:
    """What it holds, and whether that is sealed and nobody here opens it."""
    try:
        return event_data.of_block(block), False
    except SealedError:
        return block.event_bytes, True


def events_in(event_data: bytes) -> list[tuple[int, int, int, int]]:
    """The events that data begins with: timestamp, event ID, and where the data of each begins and ends."""
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


def _names(home: CameHome) -> dict[str, str]:
    """What people call the blocks. One that was edited has no ordinal of its own."""
    claims = home.claims
    exports: dict[int, Export] = {}
    for agent_id, export in home.exports.items():
        earlier = [each.export for each in home.earlier if each.export.agent_id == agent_id]
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
    for agent_id, completed in home.traced.items():
        exports[agent_id] = Export.model_construct(
            agent_id=agent_id, completed=completed, chain=[], blocks_to_be_committed=[], reconcile_stack=[]
        )
    names = name_blocks(exports)
    edited = {true: f"{names.get(claimed, claimed[:12])} (edited)" for true, claimed in claims.items()}
    return {**edited, **names}


def _held(home: CameHome) -> dict[str, list[Held]]:
    """Where each block is held, by hash."""
    where: dict[str, dict[tuple[Place, int | None, str | None], list[int]]] = defaultdict(lambda: defaultdict(list))
    for agent_id, export in home.exports.items():
        for position, block in enumerate(export.chain, 1):
            where[block.block_hash]["chain", position, block.chain_hash].append(agent_id)
        for position, block in enumerate(export.blocks_to_be_committed, 1):
            where[block.block_hash]["deque", position, None].append(agent_id)
        for position, block in enumerate(export.reconcile_stack, 1):
            where[block.block_hash]["stack", position, None].append(agent_id)
    for brought in home.earlier:
        for block_hash in brought.blocks():
            agents = where[block_hash]["earlier export", None, None]
            if brought.export.agent_id not in agents:
                agents.append(brought.export.agent_id)
    return {
        block_hash: [
            Held(place=place, position=position, chain_hash=chain_hash, agents=sorted(agents))
            for (place, position, chain_hash), agents in places.items()
        ]
        for block_hash, places in where.items()
    }


def _add_unfinished(on_record: list[BlockOnRecord], home: CameHome) -> None:
    """What agents were building: blocks of their own, or the beginning of some that are on record."""
    building = [
        (base64.b64decode(export.current_block.event_data), export)
        for export in (brought.export for brought in home.brought)
        if export.current_block.event_data
    ]
    builders = {export.agent_id for _, export in building}
    own = [block for block in on_record if block.line.agent_id in builders]
    for data, export in sorted(building, key=lambda each: (-len(each[0]), each[1].agent_id)):
        agent_id = export.agent_id
        whole = next(
            (each for each in own if each.line.agent_id == agent_id and each.event_data.startswith(data)), None
        )
        if whole is None:
            events = events_in(data)
            line = Block(
                number=len(on_record) + 1,
                name=f"{agent_id}.{UNFINISHED}",
                agent_id=agent_id,
                timestamp_us=events[-1][0] if events else export.exported_at_us,
                block_hash=None,
                events=len(events),
                mutual=False,
                held=[],
                unreadable=_unreadable(data, events),
            )
            whole = BlockOnRecord(line, data)
            on_record.append(whole)
            own.append(whole)
        holding = Held(place="current block", position=None, chain_hash=None, agents=[agent_id])
        if holding not in whole.line.held:
            whole.line.held.append(holding)


def _forks(chains: Mapping[int, Sequence[str]], names: Mapping[str, str]) -> list[Fork]:
    """Where chains part, the lowest first."""
    forks = []
    together = [(0, sorted(chains))]
    while together:
        height, agents = together.pop()
        ways: dict[str | None, list[int]] = {}
        while True:
            ways = {}
            for agent_id in agents:
                chain = chains[agent_id]
                ways.setdefault(chain[height] if height < len(chain) else None, []).append(agent_id)
            if len(ways) > 1 or None in ways:
                break
            height += 1
        if len(ways) == 1:
            continue
        last = chains[agents[0]][height - 1] if height else None
        going = [Way(agents=way, next=names[block] if block else None, next_hash=block) for block, way in ways.items()]
        forks.append(Fork(height=height, after=names[last] if last else None, after_hash=last, ways=going))
        together += [(height + 1, way) for block, way in ways.items() if block is not None and len(way) > 1]
    return sorted(forks, key=lambda fork: (fork.height, fork.ways[0].agents))


def _lost_blocks(
    home: CameHome, blocks: Mapping[str, ExportedBlock], names: Mapping[str, str], absent: Sequence[int]
) -> list[Lost]:
    """Blocks that their agents say to have completed, and that are nowhere."""
    lost: dict[str, Lost] = {}
    edited = {*home.claims.values()}
    for brought in home.brought:
        agent_id = brought.export.agent_id
        for block_hash in brought.export.completed:
            if block_hash in blocks or block_hash in lost:
                continue
            why = f"agent {agent_id} completed it, but its export does not contain it"
            if absent:
                why += f"; vehicles without an export may have it: {', '.join(ranges([*absent]))}"
            if block_hash in edited:
                why += "; a file has other data under its hash"
            lost[block_hash] = Lost(
                agent_id=agent_id,
                block=names[block_hash],
                block_hash=block_hash,
                agents=[*absent] or [agent_id],
                why=why,
            )
    for agent_id, completed in home.traced.items():
        for block_hash in completed:
            if block_hash not in blocks:
                why = f"agent {agent_id} completed it according to its trace, but no export contains it"
                lost[block_hash] = Lost(
                    agent_id=agent_id, block=names[block_hash], block_hash=block_hash, agents=[agent_id], why=why
                )
    return [*lost.values()]


def _missing(agent_id: int, blocks: int) -> Lost:
    others = {0: "no export has blocks of it", 1: "other exports have 1 block of it"}.get(
        blocks, f"other exports have {blocks} of its blocks"
    )
    why = f"vehicle {agent_id} has no export: {others}; its other logged events are missing"
    return Lost(agent_id=agent_id, agents=[agent_id], why=why)
