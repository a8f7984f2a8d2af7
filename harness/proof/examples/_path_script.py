"""Write a path through the state graph as a scenario.

Scripted events, message fates and timer delays make the simulation take the same path. A message takes LATENCY_S. An
*instant* is a moment at which one or more agents act. If the path requires a different order of arrivals, or if the
next instant follows soon, a message fate in the scenario changes the delay of the message. If the path loses a message,
the message gets the fate `drop`. A timer expires on time, unless messages of the previous instant arrive later.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from typing import Any, NamedTuple

from harness.proof.attacker._timeline_entries import AttackEntries
from harness.proof.bounds import EVENT_FILLS_BLOCK
from harness.proof.examples._path_times import BlockAges, TimerRun, instants_s, windows_s
from harness.proof.graph._exploration import StateGraph
from harness.proof.model._global_states import AGENTS, SwarmTransition
from harness.proof.model._instant import AgentAction, MessageRound
from harness.proof.model._known_states import DEAD
from harness.proof.model._snapshot import AgentStep
from harness.scenario.strict_model import format_pairs
from netem.medium import LATENCY

LATENCY_S = 0.02
ROGUE_LATENCY_S = LATENCY.mean_s
"""Seconds from the sending of a rogue node's message to its arrival."""
MOMENT_S = 0.001
"""Seconds between two events that must happen in a certain order."""
NEXT_INSTANT_SOON_S = 0.1
"""If the next instant follows within this number of seconds, messages take only MOMENT_S, so that they arrive before
the next instant.
"""
SETTLES_S = 60
NO_CLOCKS = "if ties of phase 2 go as no clocks make them go"
"""A text for paths that need impossible clocks. On such a path, each of two blocks would have to be older than the
other, or the clock of an agent would have to go back.
"""

Document = dict[str, Any]


@dataclass(eq=False)
class _BroadcastOnPath:
    """A message that an agent broadcasts on a path through the state graph. `count` is its number among the messages of
    the same sender and type.
    """

    sender: int
    message: int
    name: str
    count: int
    sent_s: float
    lost_by: list[int] = field(default_factory=list)


@dataclass
class _AgentOnPath:
    """An agent on a path through the state graph. `timers` contains, for each running timer, its number among all
    timers that the agent started, and the time of its expiry.
    """

    agent_id: int
    local: int
    timers: dict[int, tuple[int, float]] = field(default_factory=dict)
    started: int = 0


class CompletionInterval(NamedTuple):
    """The interval in which an agent may complete a block, in seconds after the start of the path."""

    agent: int
    earliest_s: float
    latest_s: float


class PathScript:
    """A writer that follows a path through the state graph step by step and collects the entries of a scenario."""

    def __init__(self, graph: StateGraph, path: Sequence[int]) -> None:
        self._graph = graph
        self._swarm = graph.swarm
        self._moves = [self._move(before, after) for before, after in pairwise(path)]
        self.coincidences = sum(
            self._swarm.coincidences(graph.states[number], move.actions)
            for number, move in zip(path, self._moves, strict=False)
        )
        """Number of coincidences on the path: pairs of independent instants that have the same time only by chance."""
        begin = graph.states[path[0]]
        self._agents = [_AgentOnPath(place + 1, local) for place, local in enumerate(begin[AGENTS:])]
        self._sent: Counter[tuple[int, str]] = Counter()
        self._events: list[Document] = []
        self._ages = BlockAges()
        self.contradictory = False
        """True if the path needs impossible clocks, because its comparisons of the ages of blocks contradict each
        other. `document` sets this value.
        """
        self.losses = 0
        """Number of messages that are lost on the path, counted once per receiver. `document` sets it."""
        self._timeline: list[Document] = []
        self._fates: list[Document] = []
        self._late: dict[int, dict[int, float]] = defaultdict(dict)
        self._end_s = 0.0
        self._latency_s = LATENCY_S
        attacker = self._swarm.attacker
        self._attack_entries = (
            None if attacker is None else AttackEntries(self._swarm.local, attacker.captured, attacker.made)
        )

    def document(self, name: str) -> Document:
        """Return the scenario as a document."""
        instants = instants_s(len(self._moves), list(self._runs()))
        for move, at_s, next_s in zip(self._moves, instants, [*instants[1:], inf], strict=True):
            self._latency_s = LATENCY_S if next_s - at_s > NEXT_INSTANT_SOON_S else MOMENT_S
            self._play(move, at_s)
        self._delay_open_timers()
        self.contradictory = not self._ages.date(self._events)
        if self._attack_entries is not None:
            self._attack_entries.word()
        bounds = self._swarm.bounds
        lateness = {
            agent_id: format_pairs(sorted(late.items()), "+") for agent_id, late in sorted(self._late.items()) if late
        }
        return {
            "name": name,
            "agents": bounds.agents,
            "duration_s": float(round(self._end_s) + SETTLES_S),
            "network": {"delay": LATENCY_S},
            "settings": {**EVENT_FILLS_BLOCK, **bounds.settings},
            **({"security": {"captured": bounds.captured}} if bounds.captured else {}),
            **({"stagger": dict(bounds.stagger)} if bounds.stagger else {}),
            **({"quirks": dict(bounds.quirks)} if bounds.quirks else {}),
            **({"timeline": self._timeline} if self._timeline else {}),
            "events": {"source": "scripted", **({"script": self._events} if self._events else {})},
            **({"fates": self._fates} if self._fates else {}),
            **({"lateness": lateness} if lateness else {}),
        }

    def completions(self) -> Iterator[CompletionInterval]:
        """Yield, for each block, the interval in which it can be completed with the timer durations of this path."""
        agents = [agent.agent_id for agent in self._agents]
        for move, (earliest_s, latest_s) in zip(
            self._moves, windows_s(len(self._moves), list(self._runs())), strict=True
        ):
            for action in move.actions:
                if action.what == "complete":
                    yield CompletionInterval(agents[action.place], earliest_s, latest_s)
            agents = [agents[old] for old in move.places]

    def _move(self, before: int, after: int) -> SwarmTransition:
        """Return a transition from one state to the next state. If possible, return a transition without lost
        messages.
        """
        state, wanted = self._graph.states[before], self._graph.states[after]
        for lossy in (False, True) if self._swarm.bounds.network == "lossy" else (False,):
            for actions in self._swarm.actions(state):
                if wanted in self._swarm.after(state, actions, lossy):
                    return next(move for move in self._swarm.moves(state, actions, lossy) if move.state == wanted)
        raise AssertionError("each state on the path is a successor of the one before")

    # Times

    def _runs(self) -> list[TimerRun]:
        """Return, for each timer on the path, the first and the last step during which it runs."""
        running: dict[tuple[int, int], tuple[int, float]] = {}
        runs = []
        for instant, move in enumerate(self._moves):
            for action in move.actions:
                if action.what == "timer":
                    began, duration_s = running.pop((action.place, action.number))
                    runs.append(TimerRun(began, duration_s, instant, True))
            runs += [TimerRun(began, duration_s, instant, False) for began, duration_s in running.values()]
            after: dict[tuple[int, int], tuple[int, float]] = {}
            for new, old in enumerate(move.places):
                local = move.state[AGENTS + new]
                for timer in self._swarm.local.known[local].running if local != DEAD else ():
                    before = running.get((old, timer))
                    started = dict(move.started[old]).get(timer)
                    if before is None or started is not None:
                        us = self._swarm.local.durations_us[timer] if started is None else started
                        before = instant, us / 1e6
                    after[new, timer] = before
            running = after
        return runs

    # Events

    def _play(self, move: SwarmTransition, at_s: float) -> None:
        """Play one instant of the path: first the actions of the agents, then the reception of all messages."""
        earliest = self._end_s + MOMENT_S if self._end_s else 0.0
        ends = [
            max(self._agents[action.place].timers[action.number][1], earliest)
            for action in move.actions
            if action.what == "timer"
        ]
        if any(action.what == "lie" for action in move.actions):
            earliest += ROGUE_LATENCY_S
        other_s = round(max([at_s, earliest, *ends]), 3)
        air: list[_BroadcastOnPath] = []
        acted_s = other_s if not ends else max(ends)
        for action in move.actions:
            agent = self._agents[action.place]
            if action.what == "timer":
                number, nominal_s = agent.timers[action.number]
                now = max(nominal_s, earliest)
                if now > nominal_s + 1e-9:
                    self._late[agent.agent_id][number] = now - nominal_s
                self._ages.require_older(*self._swarm.local.older(agent.local, action.number, action.result))
                step = self._swarm.local.end_timer(agent.local, action.number, action.result)
            else:
                now = other_s
                if action.what != "lie":  # all receivers get a lie at the same moment
                    other_s = round(other_s + MOMENT_S, 3)
                step = self._act(agent, action, now)
            acted_s = max(acted_s, now)
            air += self._apply(agent, step, now)
        self._end_s = max(self._end_s, acted_s)
        for message_round in _rounds_in_order(move.last_round):
            air = self._hear(message_round, self._in_round_order(message_round, air), acted_s)
        self._ages.renumber(move.blocks)
        self._agents = [self._agents[old] for old in move.places]
        for agent, local in zip(self._agents, move.state[AGENTS:], strict=True):
            agent.local = local

    def _act(self, agent: _AgentOnPath, action: AgentAction, now: float) -> AgentStep:
        if action.what == "complete":
            self._events.append({"at_s": now, "agent": agent.agent_id})
            self._ages.completed(action.number)
            step = self._swarm.local.complete(agent.local, action.number)
            if self._attack_entries is not None:
                self._attack_entries.completed(agent.agent_id, action.number, now)
            return step
        if action.what == "lie" and self._attack_entries is not None:
            self._timeline += self._attack_entries.lie(agent.agent_id, action.number, round(now - ROGUE_LATENCY_S, 6))
            return self._swarm.local.lie(agent.local, action.number)
        agent.timers = {}
        if action.what == "reboot":
            self._timeline.append({"at_s": now, "reboot": [agent.agent_id], "down_s": MOMENT_S, "disk": "kept"})
            return self._swarm.local.reboot(agent.local)
        self._timeline.append({"at_s": now, "kill": [agent.agent_id]})
        return AgentStep(DEAD, (), ())

    def _apply(self, agent: _AgentOnPath, step: AgentStep, now: float) -> list[_BroadcastOnPath]:
        """Apply a step to an agent, and return the messages that it broadcasts."""
        agent.local = step.local
        if self._attack_entries is not None and step.local != DEAD:
            self._attack_entries.sees(step.local)
        running = self._swarm.local.known[step.local].running if step.local != DEAD else ()
        agent.timers = {timer: run for timer, run in agent.timers.items() if timer in running}
        started = dict(step.started)
        for timer in running:
            if timer in started or timer not in agent.timers:
                us = started.get(timer, self._swarm.local.durations_us[timer])
                agent.timers[timer] = agent.started, now + us / 1e6
                agent.started += 1
        flights = []
        for message in step.sent:
            name = self._swarm.local.messages[message].NAME
            self._sent[agent.agent_id, name] += 1
            flights.append(_BroadcastOnPath(agent.agent_id, message, name, self._sent[agent.agent_id, name], now))
        return flights

    def _in_round_order(
        self, message_round: MessageRound, flights: Sequence[_BroadcastOnPath]
    ) -> list[_BroadcastOnPath]:
        """Return the broadcasts in the order in which `message_round` lists them."""
        left, ordered = list(flights), []
        for place, message in message_round.air:
            sender = self._agents[place].agent_id
            flight = next(flight for flight in left if (flight.sender, flight.message) == (sender, message))
            left.remove(flight)
            ordered.append(flight)
        return ordered

    def _hear(
        self, message_round: MessageRound, air: Sequence[_BroadcastOnPath], acted_s: float
    ) -> list[_BroadcastOnPath]:
        """Deliver the messages in `message_round` to each agent, and return the answers."""
        answers: dict[int, list[_BroadcastOnPath]] = {}
        received: set[int] = set()
        for place, heard in enumerate(message_round.heard):
            agent = self._agents[place]
            answers[place] = []
            if agent.local == DEAD:
                continue
            for number, flight in enumerate(air):
                if flight.sender != agent.agent_id and number not in heard:
                    flight.lost_by.append(agent.agent_id)
                    self.losses += 1
            order_matters = self._swarm.order_matters(agent.local, place, message_round, heard)
            last_s = acted_s
            for number in heard:
                received.add(number)
                flight = air[number]
                arrives_s = flight.sent_s + self._latency_s
                hurried = self._latency_s < LATENCY_S
                if arrives_s <= last_s:
                    arrives_s = last_s + MOMENT_S
                    hurried = hurried or order_matters
                if hurried:
                    self._fate(flight, agent.agent_id, delay_s=round(arrives_s - flight.sent_s, 6))
                last_s = arrives_s
                self._end_s = max(self._end_s, arrives_s)
                sender = self._swarm.name_of(message_round.air[number][0], place)
                answers[place] += self._apply(
                    agent, self._swarm.local.hear(agent.local, sender, flight.message), last_s
                )
        for number, flight in enumerate(air):
            if number not in received and len(flight.lost_by) > 1:
                self._fate(flight, None, drop=True)
            else:
                for agent_id in flight.lost_by:
                    self._fate(flight, agent_id, drop=True)
        return [flight for place in range(len(message_round.heard)) for flight in answers[place]]

    def _fate(self, flight: _BroadcastOnPath, receiver: int | None, **what: Any) -> None:
        whom = {} if receiver is None else {"receiver": receiver}
        self._fates.append({"message": flight.name, "sender": flight.sender, **whom, "count": flight.count, **what})

    def _delay_open_timers(self) -> None:
        """Delay each timer that still runs at the end of the path, so that it does not expire before the end."""
        for agent in self._agents:
            for number, ends_s in agent.timers.values():
                if ends_s <= self._end_s:
                    self._late[agent.agent_id][number] = self._end_s + MOMENT_S - ends_s


def _rounds_in_order(last: MessageRound | None) -> list[MessageRound]:
    rounds = []
    while last is not None:
        rounds.append(last)
        last = last.before
    return rounds[::-1]
