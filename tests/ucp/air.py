"""Run a few agents in virtual time. For each delivery, a test chooses the delay or the loss."""

import heapq
import itertools
from collections.abc import Callable, Iterable
from random import Random

from ucp.agent import Agent
from ucp.events import LoggableEvent, RandomEvents
from ucp.messages import Message, encode
from ucp.settings import Settings
from ucp.trace import HandlerRun

Fate = Callable[[int, int, Message], list[float]]
"""A function that returns the delays of the deliveries of a message in seconds.

Its arguments are the sender, the receiver and the message. With an empty list, the message is lost.
"""

INITIAL_DATA = b"test mission"


class Air:
    def __init__(self, roster: Iterable[int], fate: Fate | None = None, settings: Settings | None = None) -> None:
        roster = list(roster)
        self.agents = {agent_id: Agent(agent_id, roster, INITIAL_DATA, settings) for agent_id in roster}
        self.fate = fate or uniform_latency(Random(0))
        self.now = 0.0
        self.runs: dict[int, list[HandlerRun]] = {agent_id: [] for agent_id in roster}
        self._in_flight: list[tuple[float, int, int, bytes]] = []
        self._order = itertools.count()
        self._sources: dict[int, tuple[RandomEvents, tuple[float, int, bytes]]] = {}

    def generate_events(self, seed: int, mean_s: float = 30.0) -> None:
        for agent_id in self.agents:
            source = RandomEvents(Random(f"{seed}/{agent_id}"), mean_s)
            self._sources[agent_id] = source, source.next()

    def stop_events(self) -> None:
        self._sources.clear()

    def log(self, agent_id: int, data: bytes = bytes(256)) -> None:
        self.agents[agent_id].add_event(LoggableEvent(round(self.now * 1e6), 7, data), self.now)
        self.flush(agent_id)

    def fill_block(self, agent_id: int) -> bytes:
        """Log events until a block is complete, and return the hash of this block."""
        agent = self.agents[agent_id]
        count = len(agent.state.completed)
        while len(agent.state.completed) == count:
            self.log(agent_id)
        return agent.state.completed[-1]

    def reconcile(self, agent_id: int) -> None:
        """Start a reconcile of the agent, and run until no event is left."""
        self.agents[agent_id].begin_reconcile(self.now)
        self.flush(agent_id)
        self.settle()

    def flush(self, agent_id: int) -> None:
        """Schedule the deliveries of the messages that the agent broadcasts."""
        agent = self.agents[agent_id]
        for sequence, message in agent.messages_to_send():
            datagram = encode(agent_id, sequence, message)
            for receiver in self.agents:
                if receiver != agent_id:
                    for delay in self.fate(agent_id, receiver, message):
                        heapq.heappush(self._in_flight, (self.now + delay, next(self._order), receiver, datagram))
        self.runs[agent_id].extend(agent.trace())

    def next_time(self) -> float | None:
        times = [time for agent in self.agents.values() if (time := agent.next_timer()) is not None]
        times += [due for _, (due, _, _) in self._sources.values()]
        times += [delivery[0] for delivery in self._in_flight[:1]]
        return min(times, default=None)

    def step(self) -> bool:
        """Run the next delivery, timer or event. Return false if none is left."""
        time = self.next_time()
        if time is None:
            return False
        self.now = max(self.now, time)
        if self._in_flight and self._in_flight[0][0] <= self.now:
            _, _, receiver, datagram = heapq.heappop(self._in_flight)
            self.agents[receiver].receive_datagram(datagram, self.now)
            self.flush(receiver)
            return True
        for agent_id, agent in self.agents.items():
            deadline = agent.next_timer()
            if deadline is not None and deadline <= self.now:
                agent.handle_timer(self.now)
                self.flush(agent_id)
                return True
        for agent_id, (source, (due, event_id, data)) in self._sources.items():
            if due <= self.now:
                self._sources[agent_id] = source, source.next()
                self.agents[agent_id].add_event(LoggableEvent(round(self.now * 1e6), event_id, data), self.now)
                self.flush(agent_id)
                return True
        return True

    def run_until(self, time: float) -> None:
        while (following := self.next_time()) is not None and following <= time:
            self.step()
        self.now = time

    def settle(self, limit_s: float = 3600.0) -> None:
        """Run until no delivery, timer or event is left."""
        limit = self.now + limit_s
        while self.step():
            assert self.now < limit, "the agents did not become idle"

    def chains(self) -> list[tuple[bytes, ...]]:
        return [tuple(block.block_hash for block in agent.state.chain) for agent in self.agents.values()]

    def branches(self, agent_id: int, handler: str) -> list[str]:
        return [run.branch for run in self.runs[agent_id] if run.handler == handler]


def uniform_latency(rng: Random, low_s: float = 0.002, high_s: float = 0.05, loss: float = 0.0) -> Fate:
    def fate(sender: int, receiver: int, message: Message) -> list[float]:
        return [] if rng.random() < loss else [rng.uniform(low_s, high_s)]

    return fate


def assert_characteristics_2_to_4(agent: Agent, completed_by: dict[int, set[bytes]]) -> None:
    """Check characteristics 2, 3 and 4 of an agent from its state."""
    chain = [block.block_hash for block in agent.state.chain]
    aside = [block.block_hash for block in (*agent.state.blocks_to_be_committed, *agent.state.reconcile_stack)]
    if agent.state.idle:
        assert not aside, "idle with blocks that are not committed"
        assert set(agent.state.completed) <= set(chain), "idle, and a completed block is not in the chain"
    assert len(set(chain + aside)) == len(chain + aside), "two copies of a block"
    for block in (*agent.state.chain, *agent.state.blocks_to_be_committed, *agent.state.reconcile_stack):
        assert block.block_hash in completed_by[block.agent_id], "a block that its agent never completed"
