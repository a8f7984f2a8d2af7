"""Compute the messages that an attacker with the keys of one vehicle can send in each state of the swarm, and their
receivers.

The attacker receives all messages. It therefore knows each block that an agent has committed, and the hash of each
proposed block. It can also create blocks in the name of the captured vehicle. In a proof, these blocks differ only in
their timestamps.
"""

from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import NamedTuple

from harness.play.rogue.lies import NOBODYS, made_block
from harness.proof.attacker._forgeries import ForgeryMaterial, PendingQuestions, asked, forgeries
from harness.proof.bounds import Bounds
from harness.proof.model._instant import AgentAction
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.messages import BlockAddRequest, BlockResponse, CommitBlock, Message
from ucp.state import AgentState

MOST_KNOWN = 200_000
"""Maximum number of cached lists of messages. When the cache exceeds this number, it is emptied."""


class _KnowledgeFromAgent(NamedTuple):
    """The blocks, hashes and queries that the attacker learned from the broadcasts of one agent."""

    asked: PendingQuestions
    committed: frozenset[Block]
    """The blocks in the agent's chain and on its reconcile stack. An agent broadcasts each block when it commits the
    block.
    """
    named: frozenset[bytes]


class ForgedTimestamps:
    """Timestamps for forged blocks. They lie before, between and after the timestamps of `blocks` honest blocks. There
    are enough timestamps to give each of up to `lies` forged blocks any age relative to the honest blocks.
    """

    def __init__(self, blocks: int, lies: int) -> None:
        part = MICROSECONDS // (2 * lies + 2)
        begins = [gap * MICROSECONDS for gap in range(blocks + 1)]
        self.of_blocks = tuple(begin + 2 * number * part for begin in begins for number in range(1, lies + 1))
        self.said = tuple(begin + (2 * number + 1) * part for begin in begins for number in range(lies + 1))


class Attacker:
    """The messages that an attacker can send in the name of the captured vehicle.

    Each message is stored in `local`, the store of agent states, and is identified by its number.
    """

    def __init__(self, bounds: Bounds, local: LocalStates) -> None:
        assert bounds.captured is not None, "a vehicle is captured"
        self.captured = bounds.captured
        self._local = local
        ages = ForgedTimestamps(bounds.blocks, max(1, bounds.lies))
        blocks = [made_block(self.captured, timestamp_us) for timestamp_us in ages.of_blocks]
        self.made = {block.block_hash: block for block in blocks}
        """Block hash -> block, for the blocks that the attacker may create."""
        self._own = frozenset(blocks)
        self._times_us = ages.said
        self._knowledge: dict[int, _KnowledgeFromAgent] = {}
        self._forgeries: dict[tuple[int, ForgeryMaterial], tuple[int, ...]] = {}

    def forged_messages(self, locals_: tuple[int, ...]) -> Iterator[tuple[AgentAction, ...]]:
        """Yield each action of the attacker. In an action, the attacker sends one message to one set of agents. An
        action is omitted if the message has no effect on at least one agent of the set.
        """
        messages = dict.fromkeys(
            message for place, material in self.material(locals_) for message in self._to(locals_[place], material)
        )
        for message in messages:
            differ = [
                AgentAction(place, "lie", message)
                for place, local in enumerate(locals_)
                if self._differs(local, message)
            ]
            for count in range(1, len(differ) + 1):
                yield from combinations(differ, count)

    def _differs(self, local: int, message: int) -> bool:
        if local == DEAD:
            return False
        step = self._local.lie(local, message)
        return step.local != local or bool(step.sent or step.started)

    def material(self, locals_: tuple[int, ...]) -> Iterator[tuple[int, ForgeryMaterial]]:
        """Yield the index of each living agent together with the blocks and hashes that the attacker can use in
        messages to this agent.
        """
        knowledge = {place: self._known_from(local) for place, local in enumerate(locals_) if local != DEAD}
        blocks = self._own.union(*(agent.committed for agent in knowledge.values()))
        named = frozenset(block.block_hash for block in blocks).union(*(agent.named for agent in knowledge.values()))
        for place in knowledge:
            others = frozenset(agent.asked for other, agent in knowledge.items() if other != place)
            yield place, ForgeryMaterial(blocks, named, others - {PendingQuestions()}, self._times_us)

    def _known_from(self, local: int) -> _KnowledgeFromAgent:
        known = self._knowledge.get(local)
        if known is None:
            known = self._knowledge[local] = looked_at(self._local.state(local))
        return known

    def _to(self, local: int, material: ForgeryMaterial) -> Iterable[int]:
        key = local, material
        numbers = self._forgeries.get(key)
        if numbers is None:
            if len(self._forgeries) >= MOST_KNOWN:
                self._forgeries.clear()
            said = forgeries(self._local.state(local), self.captured, material)
            numbers = self._forgeries[key] = tuple(self._local.message(message) for message in said)
        return numbers


class AttackerKnowledge:
    """The knowledge of the attacker in the network model `any`, where each agent is explored alone. The attacker can
    send each message to each agent any number of times.

    Blocks are numbered in the order of their timestamps. The blocks with the numbers `ordinals` name the captured
    vehicle as their author. The attacker knows these blocks from the beginning.

    The attacker repeats the proposals of other agents. It does not repeat their queries, because each agent can receive
    the original queries.
    """

    def __init__(self, bounds: Bounds, ordinals: Iterable[int]) -> None:
        assert bounds.captured is not None, "a vehicle is captured"
        self._captured = bounds.captured
        self._blocks = {made_block(self._captured, ordinal * MICROSECONDS) for ordinal in ordinals}
        self._named = {NOBODYS, *(block.block_hash for block in self._blocks)}
        self._proposals: dict[int, set[PendingQuestions]] = {}
        self._times_us = ForgedTimestamps(bounds.blocks, 0).said

    def hears(self, sender: int, message: Message) -> None:
        """Add the blocks and hashes in an agent's message to the knowledge of the attacker."""
        if isinstance(message, BlockAddRequest):
            self._named.add(message.block_hash)
            self._proposals.setdefault(sender, set()).add(PendingQuestions((message.block_hash, message.chain_hash)))
        elif isinstance(message, CommitBlock | BlockResponse):
            self._named.add(message.block.block_hash)
            self._blocks.add(message.block)

    def material(self, agent_id: int) -> ForgeryMaterial:
        """Return the blocks and hashes that the attacker can use in messages to an agent."""
        others = [asked for sender, proposals in self._proposals.items() if sender != agent_id for asked in proposals]
        return ForgeryMaterial(frozenset(self._blocks), frozenset(self._named), frozenset(others), self._times_us)

    def forgeries(self, state: AgentState, material: ForgeryMaterial) -> list[Message]:
        """Return the attacker's messages that can have an effect on an agent in this state."""
        return list(forgeries(state, self._captured, material))


def looked_at(state: AgentState) -> _KnowledgeFromAgent:
    """Return the blocks, hashes and queries that the attacker learns from an agent in this state."""
    committed = frozenset((*state.chain, *state.reconcile_stack))
    return _KnowledgeFromAgent(
        asked(state), committed, frozenset(block.block_hash for block in state.blocks_to_be_committed)
    )
