"""Compute the possible results of one instant. An instant is a moment at which timers expire or blocks are completed,
and then agents receive all resulting messages.

Several agents may act before they receive each other's messages, so their messages cross. The agents receive the
messages in any order of the senders. Then the agents receive the answers to these messages, and so on until no agent
sends a message. A receiver in a lossy network may lose any of the messages. If an agent sends several messages in one
action, they arrive in order. Answers can overtake each other.

For each agent, the results of all orders and all losses are computed once. In most cases there are only one or two
different results.
"""

from collections.abc import Iterator, Sequence
from itertools import chain, product
from typing import NamedTuple, TypeVar

from harness.proof.bounds import Bounds
from harness.proof.model._known_states import DEAD
from harness.proof.model._local_steps import LocalStates
from harness.proof.model._snapshot import AgentStep, Started

ReceivedMessages = tuple[tuple[int, int], ...]
"""The messages that reach an agent in one round, in the order of the senders. Each message is a pair: the ID that this
agent uses for the sender, and the number of the message.
"""


ANSWERED = 2
"""The round of an instant in which answers are received. Queries are received in the round before it."""


MOST_KNOWN = 200_000
"""Maximum number of cached outcomes. When the cache exceeds this number, it is emptied."""
MOST_SEEN = 500
"""Maximum number of states that a correct agent can reach by one round of messages. A faulty agent that counts messages
without limit could reach more.
"""


class AgentAction(NamedTuple):
    """An action of one agent. `what` is one of these:

    - "timer": the timer `number` expires. If this has several possible results because any block may be the older one,
      `result` selects the result.
    - "complete": the agent completes the block `number`.
    - the name of a fault.
    - "captured": the attacker captures the agent.
    - "lie": the agent receives the attacker's forged message `number`.
    """

    place: int
    what: str
    number: int = 0
    result: int = 0


Actions = tuple[AgentAction, ...]
"""The simultaneous actions of an instant."""


class AgentStates(NamedTuple):
    """The states of all agents, and the timers that each agent started in the current instant."""

    locals: tuple[int, ...]
    started: tuple[Started, ...]


class MessageRound(NamedTuple):
    """A round of messages: the sent messages, and the messages that each agent received.

    `air` contains each sent message as (position of the sender, message). For each agent, `heard` contains the indices
    in `air` of the messages that it received, in order.
    """

    before: "MessageRound | None"
    air: tuple[tuple[int, int], ...]
    heard: tuple[tuple[int, ...], ...]


class FinalMessageRound(NamedTuple):
    """The last round of messages in an instant. `last_round` contains this round and, linked to it, all earlier rounds.

    `lost` is the number of lost messages. A message counts once for each receiver that loses it. The number is 0 if
    losses are not counted.
    """

    lost: int
    last_round: MessageRound | None


_Said = tuple[tuple[int, int], ...]
"""The messages of a round, each as (position of the sender, message)."""
_Agent = tuple[int, int, Started]
"""An agent: its position, its local state, and the timers that it has started in this instant."""
_Choice = tuple[int, Started, _Said, tuple[int, ...], int]
"""A possible result for one agent: its local state, started timers, sent messages, received messages in order, and
number of lost messages.
"""


_Key = TypeVar("_Key")
_Outcome = tuple[AgentStep, tuple[int, ...]]
"""A step of an agent, and an order of received messages that leads to this step. The order consists of the indices of
the messages.
"""


class InstantOutcomes:
    """A cache of the possible results of simultaneous actions. Missing results are computed."""

    def __init__(self, local: LocalStates, bounds: Bounds, *, every_order: bool = False) -> None:
        self._local = local
        self._bounds = bounds
        self._twice = "duplicate" in bounds.faults
        self._counts_losses = bounds.losses is not None
        self._any_order_of_counting = bounds.reduced and not self._twice and not every_order
        self._outcomes: dict[tuple[int, ReceivedMessages, bool, bool], list[_Outcome]] = {}
        self._choices_of: dict[tuple[_Said, bool, bool], dict[_Agent, list[_Choice]]] = {}
        self._choices_known = 0
        self._places = range(bounds.agents)
        self._names = [
            [other + 2 if bounds.nameless and other < place else other + 1 for other in self._places]
            for place in self._places
        ]

    def name_of(self, other: int, place: int) -> int:
        """Return the ID that the agent at position `place` uses for the agent at position `other`."""
        return self._names[place][other]

    def order_matters(self, local: int, place: int, message_round: MessageRound, heard: Sequence[int]) -> bool:
        """Return true if the state of the agent at `place` depends on the order in which it receives the messages of
        this round.
        """
        reached = tuple(
            (self.name_of(message_round.air[number][0], place), message_round.air[number][1])
            for number in sorted(heard)
        )
        return len(self._outcomes_of(local, reached, lossy=False, answered=message_round.before is not None)) > 1

    def outcomes(
        self, locals_: tuple[int, ...], actions: Sequence[AgentAction], most_lost: int, *, with_rounds: bool
    ) -> dict[AgentStates, FinalMessageRound]:
        """Return the possible results of these actions. If several sequences of messages lead to the same result, keep
        the one with the fewest lost messages.

        If `with_rounds` is true, the result includes the rounds of messages.
        """
        agents, started = list(locals_), [()] * len(locals_)  # type: list[int], list[Started]
        air: list[tuple[int, int]] = []
        for action in actions:
            place = action.place
            step = self._act(agents[place], action)
            agents[place] = step.local
            if action.what in ("death", "reboot", "captured"):
                started[place] = ()
            started[place] = self._still_running(started[place], step)
            air += [(place, message) for message in step.sent]
        waiting: dict[tuple[AgentStates, _Said], FinalMessageRound]
        waiting = {(AgentStates(tuple(agents), tuple(started)), tuple(air)): FinalMessageRound(0, None)}
        silent: dict[AgentStates, FinalMessageRound] = {}
        flawed = self._local.flawed
        rounds = 0
        while waiting:
            rounds += 1
            after: dict[tuple[AgentStates, _Said], FinalMessageRound] = {}
            for (there, said), ending in waiting.items():
                if not said or not flawed.isdisjoint(there.locals):
                    _keep(silent, there, ending)
                    continue
                for heard, answers, orders, lost in self._hear(there, said, most_lost - ending.lost, rounds):
                    known = after.get((heard, answers))
                    if known is None or ending.lost + lost < known.lost:
                        message_round = MessageRound(ending.last_round, said, orders) if with_rounds else None
                        after[heard, answers] = FinalMessageRound(ending.lost + lost, message_round)
            waiting = after
        if not self._bounds.settles:
            return silent
        settled: dict[AgentStates, FinalMessageRound] = {}
        for there, ending in silent.items():
            _keep(settled, AgentStates(tuple(map(self._local.settled, there.locals)), there.started), ending)
        return settled

    def _act(self, local: int, action: AgentAction) -> AgentStep:
        if action.what == "timer":
            return self._local.end_timer(local, action.number, action.result)
        if action.what == "complete":
            return self._local.complete(local, action.number)
        if action.what == "reboot":
            return self._local.reboot(local)
        if action.what == "lie":
            return self._local.lie(local, action.number)
        return AgentStep(DEAD, (), ())

    def _hear(
        self, there: AgentStates, said: _Said, most_lost: int, rounds: int
    ) -> Iterator[tuple[AgentStates, _Said, tuple[tuple[int, ...], ...], int]]:
        answered, lossy = rounds >= ANSWERED, most_lost > 0
        if self._choices_known >= MOST_KNOWN:
            self._choices_of.clear()
            self._choices_known = 0
        known = self._choices_of.setdefault((said, lossy, answered), {})
        choices = [
            known.get(agent) or self._choices(known, agent, said, lossy, answered)
            for agent in zip(self._places, there.locals, there.started, strict=True)
        ]
        for chosen in _within(choices, most_lost) if lossy and self._counts_losses else product(*choices):
            locals_, started, answers, orders, lost = zip(*chosen, strict=True)
            yield AgentStates(locals_, started), tuple(chain.from_iterable(answers)), orders, sum(lost)

    def _choices(
        self, known: dict[_Agent, list[_Choice]], agent: _Agent, said: _Said, lossy: bool, answered: bool
    ) -> list[_Choice]:
        """Return the possible results of a round of messages for one agent, and store them in the cache."""
        place, local, before = agent
        if local == DEAD:
            return [(DEAD, (), (), (), 0)]
        mine = [number for number, (sender, _) in enumerate(said) if sender != place]
        heard = tuple((self.name_of(said[number][0], place), said[number][1]) for number in mine)
        self._choices_known += 1
        choices = known[agent] = [
            (
                step.local,
                self._still_running(before, step),
                tuple((place, message) for message in step.sent),
                tuple(mine[position] for position in order),
                len(mine) - len(set(order)) if lossy and self._counts_losses else 0,
            )
            for step, order in self._outcomes_of(local, heard, lossy, answered)
        ]
        return choices

    def _still_running(self, before: Started, step: AgentStep) -> Started:
        """Return the timers that an agent started in the current instant and that are still running."""
        if not before and not step.started:
            return ()
        if step.local == DEAD:
            return ()
        started = step.started or before
        if before and step.started:
            started = tuple(sorted({**dict(before), **dict(step.started)}.items()))
        running = self._local.known[step.local].running
        return tuple([item for item in started if item[0] in running])

    def _outcomes_of(self, local: int, heard: ReceivedMessages, lossy: bool, answered: bool) -> list[_Outcome]:
        """Return the possible steps of an agent that receives these messages. With each step, return an order of the
        messages that leads to the step.
        """
        key = local, heard, lossy, answered
        outcomes = self._outcomes.get(key)
        if outcomes is None:
            names = self._local.first_names(local, [sender for sender, _ in heard])
            if names is None:
                counted = self._when_counting(local, heard, lossy)
                outcomes = list(self._in_any_order(local, heard, lossy, not answered)) if counted is None else counted
            else:
                called = tuple((names[sender - 2], message) for sender, message in heard)
                outcomes = [
                    (step._replace(local=self._local.renamed_back(step.local, names)), order)
                    for step, order in self._outcomes_of(local, called, lossy, answered)
                ]
                self._outcomes[key] = outcomes
                return outcomes
            if self._bounds.reduced:
                if answered and self._bounds.settles:
                    settled: dict[AgentStep, tuple[int, ...]] = {}
                    for step, order in reversed(outcomes):
                        _keep_fullest(settled, step._replace(local=self._local.settled(step.local)), order)
                    outcomes = list(settled.items())
                if lossy and not self._counts_losses:  # losing the additional messages may count as several losses
                    outcomes = [outcome for outcome in outcomes if not _is_covered(outcome[0], outcomes)]
            if len(self._outcomes) >= MOST_KNOWN:
                self._outcomes.clear()
            self._outcomes[key] = outcomes
        return outcomes

    def _when_counting(self, local: int, heard: ReceivedMessages, lossy: bool) -> list[_Outcome] | None:
        """Return the possible results if the agent only counts or ignores each of these messages. The order of the
        messages then has no effect. Return None if the agent does anything else with one of the messages.

        Whether the agent counts an answer depends on only two things: the state without the vote counts, and whether
        the sender of the answer is already counted (docs/explanation/proof.md).
        """
        hear, only_counts, lets_be = self._local.hear, self._local.only_counts, self._local.lets_be
        matter, others = [], []
        for position, (sender, message) in enumerate(heard):
            if lets_be(local, sender, message):
                others.append(position)
            elif self._any_order_of_counting and only_counts(local, sender, message):
                matter.append(position)
            else:
                return None
        if len({heard[position][0] for position in matter}) < len(matter):
            return None
        orders: dict[int, tuple[int, ...]] = {local: ()}
        for position in matter:
            sender, message = heard[position]
            if not all(only_counts(at, sender, message) for at in orders):
                return None
            after = dict(orders) if lossy else {}
            for at, order in orders.items():
                _keep_fullest(after, hear(at, sender, message).local, (*order, position))
            orders = after
        return [(AgentStep(at, (), ()), (*order, *others)) for at, order in orders.items()]

    def _in_any_order(self, local: int, heard: ReceivedMessages, lossy: bool, in_order: bool) -> Iterator[_Outcome]:
        matter = self._that_matter(local, heard)
        copies = 2 if self._twice else 1
        earlier = {  # of the same sender
            position: [
                other for other in matter if in_order and other < position and heard[other][0] == heard[position][0]
            ]
            for position in matter
        }
        begin = (AgentStep(local, (), ()), tuple(copies if position in matter else 0 for position in range(len(heard))))
        orders: dict[tuple[AgentStep, tuple[int, ...]], tuple[int, ...]] = {begin: ()}
        waiting = [begin]
        while waiting:
            node = waiting.pop()
            (at, sent, started), left = node
            for position in matter:
                if not left[position]:
                    continue
                if not lossy and any(left[other] == copies for other in earlier[position]):
                    continue  # the one before has not been heard
                step = self._local.hear(at, *heard[position])
                still = list(left)
                still[position] -= 1
                for other in earlier[position]:
                    still[other] = 0
                after = (
                    AgentStep(step.local, tuple(sorted(sent + step.sent)), self._still_running(started, step)),
                    tuple(still),
                )
                if after not in orders:
                    orders[after] = (*orders[node], position)
                    waiting.append(after)
        outcomes: dict[AgentStep, tuple[int, ...]] = {}
        for (step, left), order in orders.items():
            ends_here = lossy or step.local in self._local.flawed or all(left[position] < copies for position in matter)
            if ends_here:
                _keep_fullest(outcomes, step, order)
        others = [position for position in range(len(heard)) if position not in matter]
        for step, order in outcomes.items():
            yield step, (*order, *others)

    def _that_matter(self, local: int, heard: ReceivedMessages) -> list[int]:
        """Return the indices of the messages that may change the agent or cause an answer, directly or after other
        messages of this round. If the agent reaches more than `MOST_SEEN` states by these messages, it is faulty, and
        the method returns all indices.
        """
        seen, waiting = {local}, [local]
        matter: set[int] = set()
        while waiting:
            if len(seen) > MOST_SEEN:
                return list(range(len(heard)))
            at = waiting.pop()
            for position, (sender, message) in enumerate(heard):
                step = self._local.hear(at, sender, message)
                if step.local != at or step.sent or step.started:
                    matter.add(position)
                    if step.local not in seen:
                        seen.add(step.local)
                        waiting.append(step.local)
        return sorted(matter)


def _keep(results: dict[AgentStates, FinalMessageRound], there: AgentStates, ending: FinalMessageRound) -> None:
    """Store the messages that lead to a result, unless stored messages with the same result have at most as many
    losses.
    """
    known = results.get(there)
    if known is None or ending.lost < known.lost:
        results[there] = ending


def _keep_fullest(orders: dict[_Key, tuple[int, ...]], there: _Key, order: tuple[int, ...]) -> None:
    """Store an order of messages that leads to a state, unless a stored order for this state contains at least as many
    different messages.
    """
    known = orders.get(there)
    if known is None or len(set(order)) > len(set(known)):
        orders[there] = order


def _within(choices: Sequence[Sequence[_Choice]], most_lost: int) -> list[tuple[_Choice, ...]]:
    """Return all combinations of the agents' choices in which at most `most_lost` messages are lost in total."""
    combined: list[tuple[int, tuple[_Choice, ...]]] = [(0, ())]
    for of_one in choices:
        combined = [
            (lost + choice[-1], (*chosen, choice))
            for lost, chosen in combined
            for choice in of_one
            if lost + choice[-1] <= most_lost
        ]
    return [chosen for _, chosen in combined]


def _is_covered(step: AgentStep, outcomes: Sequence[_Outcome]) -> bool:
    """Return true if another possible step differs from this step only by additional sent messages. The network may
    lose these additional messages, so the other step covers this one.
    """
    return any(
        other.local == step.local
        and other.started == step.started
        and len(other.sent) > len(step.sent)
        and _is_part(step.sent, other.sent)
        for other, _ in outcomes
    )


def _is_part(some: tuple[int, ...], of: tuple[int, ...]) -> bool:
    """Return true if all elements of `some` occur in `of`, in the same order."""
    rest = iter(of)
    return all(message in rest for message in some)
