"""Simulate the protocol with a minimal model in one file. The speed measurements use the model as their unit.

`python -m benchmarks.bare_model --agents 5 --loss 0.15 --seeds 20` prints the results of missions of the model, as a
check of the model.

The model plays a mission of 20 minutes with Algorithms 1 to 21, in the reading of the thesis that the agents use by
default. All messages go through one queue, which has an entry for each receiver that does not lose the message. A
programmer would write such a model to study the protocol alone. The model has no datagrams, no records, no checks and
no faults, and all agents are correct. Hashes are those of Python tuples, not SHA-256.

A mission of the model and a simulated run use their random numbers differently. With the same seed, they are different
samples of the same distribution. Therefore a comparison needs several seeds.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections import deque
from collections.abc import Callable
from heapq import heappop, heappush
from random import Random
from typing import Any, NamedTuple

MISSION_S = 1200.0
VOTE_S = 10.0
PHASE_S = 5.0
GAP_S = 0.1
LATENCY_S = (0.002, 0.05)
"""Minimum and maximum delay of a message in seconds."""
EVENT_MEAN_S = 30.0
EVENT_BYTES = (32, 64, 128, 256)
EVENT_HEADER_BYTES = 11
FULL_BYTES = 1024 - 256 - EVENT_HEADER_BYTES
INCEPTION = 0
TOP = (0, 0)
"""The answer "Is Top Of Chain". In sorted order, it comes before every block."""

Block = tuple[int, int]
"""A block as a pair: the ID of its agent, and its number among the blocks of this agent."""


class Tally:
    """The votes for and against a block, and the agents that have voted."""

    def __init__(self, yes: int = 0) -> None:
        self.yes = yes
        self.no = 0
        self.voters: set[int] = set()

    def count(self, sender: int, approves: bool) -> None:
        if sender not in self.voters:
            self.voters.add(sender)
            if approves:
                self.yes += 1
            else:
                self.no += 1


class Due(NamedTuple):
    """An entry of the queue: a call of `handler` with `arguments` at the time `at`."""

    at: float
    rank: int
    handler: Callable[..., None]
    arguments: tuple[Any, ...]


class Network:
    """The simulated network, with a queue of all inputs in order of time."""

    def __init__(self, agents: int, loss: float, seed: int) -> None:
        self.now = 0.0
        self.messages = 0
        self.random = Random(seed)
        self.loss = loss
        self._queue: list[Due] = []
        self._rank = 0
        self.agents = [BareAgent(number, self) for number in range(1, agents + 1)]

    def after(self, delay_s: float, handler: Callable[..., None], *arguments: Any) -> None:
        self._rank += 1
        heappush(self._queue, Due(self.now + delay_s, self._rank, handler, arguments))

    def broadcast(self, sender: BareAgent, handler: str, *arguments: Any) -> None:
        """Send a message to all other agents. `handler` is the method that receives it."""
        self.messages += 1
        least, greatest = LATENCY_S
        draw = self.random.random
        for agent in self.agents:
            if agent is not sender and draw() >= self.loss:
                self.after(least + (greatest - least) * draw(), getattr(agent, handler), sender.number, *arguments)

    def run(self, until_s: float) -> None:
        """Handle all inputs up to the time `until_s`. Stop earlier when no input is left."""
        queue = self._queue
        while queue and queue[0].at <= until_s:
            due = heappop(queue)
            self.now = due.at
            due.handler(*due.arguments)


class BareAgent:
    """An agent of the model."""

    def __init__(self, number: int, network: Network) -> None:
        self.number = number
        self._network = network
        self._block_bytes = 0
        self._completed = 0
        self._deque: deque[Block] = deque()
        self.chain: list[Block] = []
        self._hashes = [INCEPTION]
        """The chain hash after each block, from the inception block on."""
        self._heights = {INCEPTION: 0}
        self._held: set[Block] = set()
        """The same blocks as in the chain, as a set."""
        self._stack: list[Block] = []
        self.reconciling = False
        self._timers: dict[str, int] = {}
        """Running timer -> the number of its last start.

        If the timer is started again or stopped, its expiry in the queue no longer has this number and is ignored.
        """
        self._starts = 0
        self._votes = Tally()
        self._voted_chain = INCEPTION
        self._answers = Tally()
        self._successors: dict[Block, list[int]] = {}
        """Successor -> the number of agents that named it, and its timestamp."""
        self._responders: set[int] = set()
        self._wanted: Block | None = None
        network.after(network.random.random(), self._maybe_log)

    # Timers and the chain

    def _start(self, timer: str, duration_s: float, handler: Callable[[], None]) -> None:
        self._starts += 1
        self._timers[timer] = self._starts
        self._network.after(duration_s, self._expire, timer, self._starts, handler)

    def _expire(self, timer: str, start: int, handler: Callable[[], None]) -> None:
        if self._timers.get(timer) == start:
            del self._timers[timer]
            handler()

    @property
    def idle(self) -> bool:
        return not self.reconciling and not self._timers

    @property
    def _top(self) -> int:
        return self._hashes[-1]

    def _commit(self, block: Block) -> None:
        top = hash((self._top, block))
        self.chain.append(block)
        self._hashes.append(top)
        self._heights[top] = len(self.chain)
        self._held.add(block)

    def _pop(self) -> None:
        block = self.chain.pop()
        del self._heights[self._hashes.pop()]
        self._held.remove(block)
        self._stack.append(block)

    # Algorithms 1 to 6, and 21

    def _maybe_log(self) -> None:
        if self._network.now >= MISSION_S:
            return
        random = self._network.random
        self._network.after(1.0, self._maybe_log)
        if random.random() > 1.0 / EVENT_MEAN_S:
            return
        self._block_bytes += EVENT_HEADER_BYTES + random.choice(EVENT_BYTES)
        if self._block_bytes >= FULL_BYTES:
            self._block_bytes = 0
            self._completed += 1
            self._deque.append((self.number, self._completed))
            self._propose()

    def _propose(self) -> None:
        if self.reconciling or "vote" in self._timers or not self._deque:
            return
        self._votes = Tally(yes=1)
        self._voted_chain = self._top
        self._start("vote", VOTE_S, self._end_vote)
        self._network.broadcast(self, "receive_proposal", self._deque[0], self._top)

    def receive_proposal(self, sender: int, block: Block, chain: int) -> None:
        if not self.reconciling:
            self._network.broadcast(self, "receive_vote", block, chain == self._top)

    def receive_vote(self, sender: int, block: Block, approves: bool) -> None:
        if "vote" in self._timers and self._deque and block == self._deque[0]:
            self._votes.count(sender, approves)

    def _end_vote(self) -> None:
        if self.reconciling:
            return
        approved = self._votes.yes > self._votes.no
        if approved and self._top != self._voted_chain:
            self._propose()
        elif approved:
            block = self._deque.popleft()
            self._commit(block)
            self._network.broadcast(self, "receive_commit", block, self._top)
            self._propose()
        else:
            self.begin_reconcile()

    def receive_commit(self, sender: int, block: Block, chain: int) -> None:
        if not self.reconciling and chain == hash((self._top, block)) and block not in self._held:
            self._commit(block)

    # Algorithms 7 to 20

    def begin_reconcile(self) -> None:
        if not self.reconciling:
            self.reconciling = True
            self._ask_contained()

    def _ask_contained(self) -> None:
        self._answers = Tally()
        self._network.broadcast(self, "receive_contain_query", self._top)
        self._start("phase 1", PHASE_S, self._end_phase_1)

    def receive_contain_query(self, sender: int, chain: int) -> None:
        if not self.reconciling:
            self._network.broadcast(self, "receive_contained", chain, chain in self._heights)

    def receive_contained(self, sender: int, chain: int, contained: bool) -> None:
        if "phase 1" in self._timers and chain == self._top:
            self._answers.count(sender, contained)

    def _end_phase_1(self) -> None:
        answers = self._answers
        if answers.yes + answers.no == 0 or (answers.yes < answers.no and not self.chain):
            self._finalize()
        elif answers.yes < answers.no:
            self._pop()
            self._ask_contained()
        else:
            self._ask_successor()

    def _ask_successor(self) -> None:
        self._successors = {}
        self._responders = set()
        self._start("phase 2", PHASE_S, self._end_phase_2)
        self._network.broadcast(self, "receive_successor_query", self._top)

    def receive_successor_query(self, sender: int, chain: int) -> None:
        if self.reconciling:
            return
        height = self._heights.get(chain)
        if height is None:
            self.begin_reconcile()
        else:
            block = self.chain[height] if height < len(self.chain) else TOP
            newest = block if block != TOP else self.chain[-1] if self.chain else TOP
            self._network.broadcast(self, "receive_successor", chain, block, newest[1])

    def receive_successor(self, sender: int, chain: int, block: Block, timestamp: int) -> None:
        if "phase 2" in self._timers and chain == self._top and sender not in self._responders:
            self._responders.add(sender)
            self._successors.setdefault(block, [0, timestamp])[0] += 1

    def _end_phase_2(self) -> None:
        if not self._successors:
            self._finalize()
            return
        most = max(count for count, _ in self._successors.values())
        tied = [block for block, (count, _) in self._successors.items() if count == most]
        block = min(tied, key=lambda block: (self._successors[block][1], block))
        if block == TOP:
            self._finalize()
        elif block in self._stack:
            self._stack.remove(block)
            self._commit(block)
            self._ask_successor()
        elif block in self._held or block in self._deque:
            self._finalize()
        else:
            self._wanted = block
            self._start("phase 3", PHASE_S, self._finalize)
            self._network.broadcast(self, "receive_block_request", block)

    def receive_block_request(self, sender: int, block: Block) -> None:
        if not self.reconciling and block in self._held:
            self._network.broadcast(self, "receive_block", block)

    def receive_block(self, sender: int, block: Block) -> None:
        if "phase 3" in self._timers and block == self._wanted:
            del self._timers["phase 3"]
            self._commit(block)
            self._ask_successor()

    def _finalize(self) -> None:
        if self._stack:
            block = self._stack.pop()
            self._commit(block)
            self._network.broadcast(self, "receive_commit", block, self._top)
            if self._stack:
                self._start("gap", GAP_S, self._finalize)
                return
        self.reconciling = False
        self._propose()


def play(agents: int, loss: float, seed: int, settle_s: float = 1200.0, *, final_reconcile: bool = True) -> Network:
    """Play a mission until all agents are idle, for at most `settle_s` seconds after minute 20. Return its network.

    With `final_reconcile`, the network then loses nothing, and each agent in turn reconciles. This repeats until a
    round of all agents changes no chain.
    """
    network = Network(agents, loss, seed)
    network.run(MISSION_S + settle_s)
    before = None
    while final_reconcile and before != (before := [agent.chain[-1:] for agent in network.agents]):
        network.loss = 0.0
        for agent in network.agents:
            agent.begin_reconcile()
            network.run(network.now + settle_s)
    return network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, default=5, help="number of agents")
    parser.add_argument("--loss", type=float, default=0.15, help="loss rate")
    parser.add_argument("--seeds", type=int, default=20, help="number of missions")
    arguments = parser.parse_args()
    ended = [play(arguments.agents, arguments.loss, seed) for seed in range(arguments.seeds)]
    blocks = statistics.mean(len({block for agent in network.agents for block in agent.chain}) for network in ended)
    uniform = sum(len({tuple(agent.chain) for agent in network.agents}) == 1 for network in ended)
    messages = statistics.mean(network.messages for network in ended)
    sys.stdout.write(f"{blocks:.1f} blocks, {messages:.0f} messages, {uniform} of {len(ended)} with one chain\n")


if __name__ == "__main__":
    main()
