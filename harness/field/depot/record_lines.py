"""Define the lines of a merged record (`ucp-consolidated/1`), and the order of its blocks.

    header      first, once: the mission, its exports, and totals
    fork        a place at which chains fork, the lowest first
    block       in the order of the record, each followed by its events
    event       each logged event, exactly once
    lost        a completed block, or a vehicle, that is in no export
    reconciled  last, if requested: the result of a final reconcile of the exports

Data is in base64, hashes are in lower-case hex, and times are in microseconds, as in blocks. The data of a block, and
so its hash, can be computed again from its events and its unreadable part.

The mutual chain comes first, in the order that all agents share. Each other block comes after the blocks that precede
it in any chain, unless the chains contradict each other. If several blocks could be next, the one with the earliest
timestamp is next, and of these the one with the lowest agent ID. If chains have some blocks in different orders, these
blocks are listed together in order of time. The same exports therefore always give the same order.
"""

from collections.abc import Iterable, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import pairwise
from operator import not_
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, RootModel

from harness.archive.exports import AgentId, Base64, ExportedBlock, ExportedInception, Hash

SCHEMA = "ucp-consolidated/1"

Number = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Place = Literal["chain", "deque", "stack", "current block", "earlier export"]
HELD_NOW: tuple[Place, ...] = ("chain", "deque", "stack")


class RecordLine(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class ExportUsed(RecordLine):
    """A chain export that was used for the record, and the number of blocks in the export. `latest` is true for the
    most recent export of an agent.
    """

    agent_id: AgentId
    file: str
    exported_at_us: Count
    latest: bool
    chain: Count
    deque: Count
    stack: Count
    completed: Count
    idle: bool
    reconcile_in_progress: bool
    top_chain_hash: Hash


class Header(RecordLine):
    """The first line of the record: the mission, its exports, and totals. `roster` contains the IDs of all agents that
    are known to have flown.

    `problems` has a sentence for each error in an export, `left_out` for each unused file, and `remarks` for other
    facts.
    """

    line: Literal["header"] = "header"
    schema_: Annotated[Literal["ucp-consolidated/1"], Field(alias="schema")] = "ucp-consolidated/1"
    inception: ExportedInception
    roster: list[AgentId]
    exports: list[ExportUsed]
    blocks: Count
    events: Count
    mutual_chain: Count
    longest_chain: Count
    distinct_chains: Count
    lost_blocks: Count
    problems: list[str]
    left_out: list[str]
    remarks: list[str]


class ForkBranch(RecordLine):
    """One branch of a fork: the agents whose chains continue with the same block `next` after the fork. `next` is null
    if the chains of these agents end at the fork.
    """

    agents: list[AgentId]
    next: str | None
    next_hash: Hash | None


class Fork(RecordLine):
    """A fork: chains differ after `height` common blocks. `after` is the last common block, or null for the inception
    block.
    """

    line: Literal["fork"] = "fork"
    height: Count
    after: str | None
    after_hash: Hash | None
    ways: list[ForkBranch]


class Holding(RecordLine):
    """A place at which some agents hold a block, and the IDs of these agents.

    The place `current block` means that the agent had not completed the block yet. The place `earlier export` means
    that only an older export of the agent contains the block. `position` counts from 1: in a chain from the inception
    block, in a deque from the front, in a stack from the bottom. Blocks with the same `chain_hash` have the same
    predecessors.
    """

    place: Place
    position: Number | None
    chain_hash: Hash | None
    agents: list[AgentId]


class Block(RecordLine):
    """The line of a block. The blocks of the record are numbered from 1 in `number`. `block_hash` is null for an
    incomplete block.

    `mutual` is true if all chains share the block. `claimed_hash` is the wrong hash in a file that was edited or
    damaged. `unreadable` is the data after the last readable event. `sealed` is true if the data is encrypted. All its
    data are then in `unreadable`.
    """

    line: Literal["block"] = "block"
    number: Number
    name: str
    agent_id: AgentId
    timestamp_us: Count
    block_hash: Hash | None
    events: Count
    mutual: bool
    held: list[Holding]
    claimed_hash: Hash | None = None
    unreadable: Base64 = ""
    sealed: Annotated[bool, Field(exclude_if=not_)] = False

    @property
    def holders(self) -> list[int]:
        """The IDs of the agents that hold the block in their chain, deque or stack, in ascending order."""
        return sorted({agent for held in self.held if held.place in HELD_NOW for agent in held.agents})


class Event(RecordLine):
    """The line of an event in the merged record. `block` is the number of the event's block, and `index` is the
    position of the event in this block, counted from 0.
    """

    line: Literal["event"] = "event"
    block: Number
    index: Count
    agent_id: AgentId
    timestamp_us: Count
    event_id: Annotated[int, Field(ge=1, le=254)]
    data: Base64


class MissingItem(RecordLine):
    """The line of a missing block of agent `agent_id`. If `block` is null, the vehicle itself is missing. `agents`
    lists the missing vehicles that may have the block. If no other vehicle is missing, the list contains only
    `agent_id`.
    """

    line: Literal["lost"] = "lost"
    agent_id: AgentId
    block: str | None = None
    block_hash: Hash | None = None
    agents: list[AgentId]
    why: str


class Vehicle(RecordLine):
    """A vehicle after the reconcile. `gained` contains the names of the blocks that the vehicle did not have before."""

    agent_id: AgentId
    chain: Count
    top_chain_hash: Hash
    gained: list[str]


class ReconcileResult(RecordLine):
    """The last line of the record: the result of a final reconcile of the exports. `chain` contains the hashes of the
    chain that all agents share, oldest first. If the agents do not all have the same chain, `chain` is empty.
    `left_out` lists the blocks that are in no chain, with the reasons.
    """

    line: Literal["reconciled"] = "reconciled"
    uniform: bool
    rounds: Count
    vehicles: list[Vehicle]
    chain: list[Hash]
    left_out: list[str]


class ConsolidatedLine(
    RootModel[Annotated[Header | Fork | Block | Event | MissingItem | ReconcileResult, Field(discriminator="line")]]
):
    """One line of a `ucp-consolidated/1` record."""


def mutual_chain(chains: Iterable[Sequence[str]]) -> Sequence[str]:
    """Return the longest common beginning of the chains."""
    first, *others = chains
    length = len(first)
    for other in others:
        length = min(length, len(other))
        if first[:length] != other[:length]:
            length = next(place for place in range(length) if first[place] != other[place])
    return first[:length]


def ordered(blocks: Mapping[str, ExportedBlock], chains: Sequence[Sequence[str]]) -> list[str]:
    """Return the hashes of `blocks` in the order of the merged record. `blocks` includes all blocks of the chains.
    `chains` contains at least one chain.
    """
    mutual = mutual_chain(chains)
    first = set(mutual)
    after: dict[str, set[str]] = {block_hash: set() for block_hash in blocks if block_hash not in first}
    remainders = [chain[len(mutual) :] for chain in dict.fromkeys(map(tuple, chains))]
    for tail in remainders:
        for below, above in pairwise(tail):
            if below != above and below in after and above in after:
                after[below].add(above)
    disjoint = sum(map(len, remainders)) == len(
        set().union(*remainders)
    )  # disjoint chains cannot contradict each other
    component = {block_hash: number for number, block_hash in enumerate(after)} if disjoint else _components(after)
    members: dict[int, list[str]] = {}
    for block_hash, number in component.items():
        members.setdefault(number, []).append(block_hash)

    def age(block_hash: str) -> tuple[int, int, str]:
        return blocks[block_hash].timestamp_us, blocks[block_hash].agent_id, block_hash

    predecessor_counts = dict.fromkeys(members, 0)
    successors: dict[int, set[int]] = {number: set() for number in members}
    for below, above in ((below, each) for below, others in after.items() for each in others):
        if component[below] != component[above] and component[above] not in successors[component[below]]:
            successors[component[below]].add(component[above])
            predecessor_counts[component[above]] += 1
    for members_in_order in members.values():
        members_in_order.sort(key=age)
    ready = [(age(members[number][0]), number) for number, count in predecessor_counts.items() if not count]
    heapify(ready)
    order = list(dict.fromkeys(mutual))
    while ready:
        _, number = heappop(ready)
        order += members[number]
        for later in successors[number]:
            predecessor_counts[later] -= 1
            if not predecessor_counts[later]:
                heappush(ready, (age(members[later][0]), later))
    return order


def _components(after: Mapping[str, set[str]]) -> dict[str, int]:
    """Return, for each block, the number of its strongly connected component (Tarjan, 1972).

    Long chains would exceed the recursion limit, so the function is iterative.
    """
    index: dict[str, int] = {}
    lowest: dict[str, int] = {}
    component: dict[str, int] = {}
    stack: list[str] = []
    for root in after:
        if root in index:
            continue
        index[root] = lowest[root] = len(index)
        stack.append(root)
        path = [(root, iter(after[root]))]
        while path:
            block, others = path[-1]
            other = next(others, None)
            if other is None:
                path.pop()
                if path:
                    below = path[-1][0]
                    lowest[below] = min(lowest[below], lowest[block])
                if lowest[block] == index[block]:
                    number = index[block]
                    while True:
                        member = stack.pop()
                        component[member] = number
                        if member == block:
                            break
            elif other not in index:
                index[other] = lowest[other] = len(index)
                stack.append(other)
                path.append((other, iter(after[other])))
            elif other not in component:
                lowest[block] = min(lowest[block], index[other])
    return component
