"""Somebody has a vehicle's keys, and speaks in its name: what it can say in each global state, and who hears it.

It hears all that is on the air, so it knows of every block that anybody has committed, and the hash of every block
that was proposed. Blocks in the vehicle's own name it makes: of whatever age, which is all that tells them apart.
"""

from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import NamedTuple

from harness.play.rogue.lies import NOBODYS, made_block
from harness.proof.attacker._forgeries import Asked, Material, asked, letters
from harness.proof.bounds import Bounds
from harness.proof.model._instant import Action
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.messages import BlockAddRequest, BlockResponse, CommitBlock, Message
from ucp.state import AgentState

MOST_KNOWN = 200_000
"""So many agents' letters are remembered; then they are worked out again."""


class _Look(NamedTuple):
    """What the captor has of one agent."""

    asked: Asked
    committed: frozenset[Block]
    """In its chain or on its stack: they were on the air when they were committed."""
    named: frozenset[bytes]


class Ages:
    """Times between those of `blocks` honest blocks, so that `lies` made-up ones stand in every order to them."""

    def __init__(self, blocks: int, lies: int) -> None:
        part = MICROSECONDS // (2 * lies + 2)
        begins = [gap * MICROSECONDS for gap in range(blocks + 1)]
        self.of_blocks = tuple(begin + 2 * number * part for begin in begins for number in range(1, lies + 1))
        self.said = tuple(begin + (2 * number + 1) * part for begin in begins for number in range(lies + 1))


class Captor:
    """What can be said in the name of `bounds.captured`. Message numbers are those of `local`."""

    def __init__(self, bounds: Bounds, local: LocalStates) -> None:
        assert bounds.captured is not None, "a vehicle is captured"
        self.captured = bounds.captured
        self._local = local
        ages = Ages(bounds.blocks, max(1, bounds.lies))
        blocks = [made_block(self.captured, timestamp_us) for timestamp_us in ages.of_blocks]
        self.made = {block.block_hash: block for block in blocks}
        """Blocks that it may make, by block hash."""
        self._own = frozenset(blocks)
        self._times_us = ages.said
        self._looks: dict[int, _Look] = {}
        self._letters: dict[tuple[int, Material], tuple[int, ...]] = {}

    def lies(self, locals_: tuple[int, ...]) -> Iterator[tuple[Action, ...]]:
        """All that it can say and that makes any difference, each heard by any of those to whom it does."""
        messages = dict.fromkeys(
            message for place, material in self.material(locals_) for message in self._to(locals_[place], material)
        )
        for message in messages:
            differ = [
                Action(place, "lie", message) for place, local in enumerate(locals_) if self._differs(local, message)
            ]
            for count in range(1, len(differ) + 1):
                yield from combinations(differ, count)

    def _differs(self, local: int, message: int) -> bool:
        if local == DEAD:
            return False
        step = self._local.lie(local, message)
        return step.local != local or bool(step.sent or step.started)

    def material(self, locals_: tuple[int, ...]) -> Iterator[tuple[int, Material]]:
        """For the agent at each place that of which it can speak to it."""
        looks = {place: self._look(local) for place, local in enumerate(locals_) if local != DEAD}
        blocks = self._own.union(*(look.committed for look in looks.values()))
        named = frozenset(block.block_hash for block in blocks).union(*(look.named for look in looks.values()))
        for place in looks:
            others = frozenset(look.asked for other, look in looks.items() if other != place)
            yield place, Material(blocks, named, others - {Asked()}, self._times_us)

    def _look(self, local: int) -> _Look:
        look = self._looks.get(local)
        if look is None:
            look = self._looks[local] = looked_at(self._local.state(local))
        return look

    def _to(self, local: int, material: Material) -> Iterable[int]:
        key = local, material
        numbers = self._letters.get(key)
        if numbers is None:
            if len(self._letters) >= MOST_KNOWN:
                self._letters.clear()
            said = letters(self._local.state(local), self.captured, material)
            numbers = self._letters[key] = tuple(self._local.message(message) for message in said)
        return numbers


class Heard:
    """What a captor has heard who says all that it can to each agent by itself, as often as it likes.

    The blocks with these `ordinals`, in the order of their ages, are those in its vehicle's name: it has them from the
    beginning. It need not repeat others' questions but proposals: who hears the captor's could have heard theirs.
    """

    def __init__(self, bounds: Bounds, ordinals: Iterable[int]) -> None:
        assert bounds.captured is not None, "a vehicle is captured"
        self._captured = bounds.captured
        self._blocks = {made_block(self._captured, ordinal * MICROSECONDS) for ordinal in ordinals}
        self._named = {NOBODYS, *(block.block_hash for block in self._blocks)}
        self._proposals: dict[int, set[Asked]] = {}
        self._times_us = Ages(bounds.blocks, 0).said

    def hears(self, sender: int, message: Message) -> None:
        """An agent has sent this."""
        if isinstance(message, BlockAddRequest):
            self._named.add(message.block_hash)
            self._proposals.setdefault(sender, set()).add(Asked((message.block_hash, message.chain_hash)))
        elif isinstance(message, CommitBlock | BlockResponse):
            self._named.add(message.block.block_hash)
            self._blocks.add(message.block)

    def material(self, agent_id: int) -> Material:
        """Of what it can speak to this agent."""
        others = [asked for sender, proposals in self._proposals.items() if sender != agent_id for asked in proposals]
        return Material(frozenset(self._blocks), frozenset(self._named), frozenset(others), self._times_us)

    def letters(self, state: AgentState, material: Material) -> list[Message]:
        """All that it can say to an agent in this state, and that makes any difference."""
        return list(letters(state, self._captured, material))


def looked_at(state: AgentState) -> _Look:
    """What the captor has of an agent in this state."""
    committed = frozenset((*state.chain, *state.reconcile_stack))
    return _Look(asked(state), committed, frozenset(block.block_hash for block in state.blocks_to_be_committed))
