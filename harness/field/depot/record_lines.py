"""The lines of a consolidated record, `ucp-consolidated/1`: JSON Lines, each an object with a key `line`.

    header      first, once: the mission, whose exports came home, how much there is
    fork        where chains part, the lowest first
    block       in the order of the record, each followed by its events
    event       every logged event, exactly once
    lost        a completed block, or a vehicle, that did not come home
    reconciled  last, if it was asked for: what a final reconcile of the exports made of them

Data is in base64, hashes in lower-case hex, times in microseconds as blocks have them. From the events of a block, and
what of it is unreadable, its data is made again byte by byte, and so its hash.
"""

from operator import not_
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, RootModel

from harness.archive.exports import AgentId, Base64, ExportedInception, Hash

SCHEMA = "ucp-consolidated/1"

Number = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]
Place = Literal["chain", "deque", "stack", "current block", "earlier export"]
HELD_NOW: tuple[Place, ...] = ("chain", "deque", "stack")


class Line(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class ExportUsed(Line):
    """An export, and what its agent held. Of several of one agent only the `latest` says what it holds now."""

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


class Header(Line):
    """`roster` are all agents that are known to have flown.

    `problems` are what is wrong with the exports, `left_out` the files that are not used and why, `remarks` what else
    must be known.
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


class Way(Line):
    """Agents whose chains go on alike, with the block `next`; null where they end."""

    agents: list[AgentId]
    next: str | None
    next_hash: Hash | None


class Fork(Line):
    """Chains part after so many blocks, `after` being the last common one; null for the inception block."""

    line: Literal["fork"] = "fork"
    height: Count
    after: str | None
    after_hash: Hash | None
    ways: list[Way]


class Held(Line):
    """`position` counts from 1: in a chain from the inception block, in a deque from the front, in a stack from below.

    The same `chain_hash` is the same history. In a `current block` the agent had the first of its events, and in an
    `earlier export` the block itself.
    """

    place: Place
    position: Number | None
    chain_hash: Hash | None
    agents: list[AgentId]


class Block(Line):
    """`number` counts the record's blocks from 1. `block_hash` is null of a block that was being built.

    `mutual`: it is in the chain that all share. `claimed_hash` is what a file says its hash is, where that is wrong: it
    was edited, or damaged. `unreadable` is what follows its events and is none. `sealed`: nobody has opened it, and it
    is `unreadable` all of it.
    """

    line: Literal["block"] = "block"
    number: Number
    name: str
    agent_id: AgentId
    timestamp_us: Count
    block_hash: Hash | None
    events: Count
    mutual: bool
    held: list[Held]
    claimed_hash: Hash | None = None
    unreadable: Base64 = ""
    sealed: Annotated[bool, Field(exclude_if=not_)] = False

    @property
    def holders(self) -> list[int]:
        """Who holds it now, wherever."""
        return sorted({agent for held in self.held if held.place in HELD_NOW for agent in held.agents})


class Event(Line):
    """The event at `index`, from 0, of the block with the number `block`."""

    line: Literal["event"] = "event"
    block: Number
    index: Count
    agent_id: AgentId
    timestamp_us: Count
    event_id: Annotated[int, Field(ge=1, le=254)]
    data: Base64


class Lost(Line):
    """A block of `agent_id`, or without a block the vehicle itself; `agents` are those with whom it was lost."""

    line: Literal["lost"] = "lost"
    agent_id: AgentId
    block: str | None = None
    block_hash: Hash | None = None
    agents: list[AgentId]
    why: str


class Vehicle(Line):
    """A vehicle after the reconcile, and the blocks, by name, that it has now and had not when it came home."""

    agent_id: AgentId
    chain: Count
    top_chain_hash: Hash
    gained: list[str]


class Reconciled(Line):
    """`chain` are the hashes of the uniform chain, oldest first; without one it is empty.

    `left_out` are blocks that no chain has, with the reason.
    """

    line: Literal["reconciled"] = "reconciled"
    uniform: bool
    rounds: Count
    vehicles: list[Vehicle]
    chain: list[Hash]
    left_out: list[str]


class ConsolidatedLine(
    RootModel[Annotated[Header | Fork | Block | Event | Lost | Reconciled, Field(discriminator="line")]]
):
    """Any line of `ucp-consolidated/1`."""
