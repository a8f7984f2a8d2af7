"""Compare the share of lost messages with the loss rate that the scenario set for the network.

Each receiver of a message loses the message independently, with a known probability. The number of lost messages is
therefore a sum of independent draws. Hoeffding's bound (1963, Theorem 1) limits the probability of an unusual share.
Let q be the mean probability of n draws, and let a be greater than q. Then the share of lost messages is at least a
with a probability of at most exp(-n KL(a, q)). KL is the relative entropy of two draws. The same bound holds for shares
below the mean. A share contradicts the records only if this probability is below `MAX_CHANCE`, so chance practically
never causes a contradiction.

The comparison counts only messages that a correct agent handles if they arrive:

- With processes and containers, it counts all messages. An agent may handle fewer messages than arrive, because it was
  stopped or its socket was full. The number of handled messages therefore contradicts the loss rate only if it is too
  high. If the engine counts packets, the number of counted packets can also be too low.
- In virtual time, it counts messages of three types, while the agent runs and does not reconcile. The simulation does
  not deliver messages of other types if they have no effect. If the core was edited or is a variant, the simulation
  delivers all messages. The comparison then counts all messages while the agent runs.

If the network duplicates messages, a message counts as handled if the agent handled one of its copies. A message
without a second copy is lost with the loss rate. A message that is both lost and duplicated arrives once. The
probability that no copy arrives is therefore the loss rate times the probability that there is no second copy.

A dropped datagram arrived, but the agent did not handle it. For example, a restarted agent of a secured mission drops
messages of agents that it has not yet confirmed. If an agent handled too few messages, its dropped datagrams therefore
count as handled.
"""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from math import exp, inf, log

from harness.archive.connectivity import Link
from harness.archive.vocabulary import MESSAGES
from harness.checker.evidence import Evidence
from harness.checker.records._captures_vs_traces import COUNTS_DATAGRAMS
from harness.checker.records._handled_vs_faults import stopped
from harness.checker.records.contradiction import Contradiction, in_virtual_time, of_agent, slack_s
from harness.scenario.changes import RANGE
from harness.scenario.faults.fault import SAME_TIME_S
from netem.conditions import NetworkConditions
from netem.link import GilbertElliott, LinkConditions
from netem.medium import LATENCY
from ucp.messages import BlockAddRequest, ChainContainQuery, CommitBlock
from ucp.trigger import MessageTrigger

NEVER_WITHHELD = frozenset(message.NAME for message in (BlockAddRequest, CommitBlock, ChainContainQuery))
"""Types of messages that the simulation always delivers to an agent that does not reconcile. To save time, the
simulation does not deliver other messages that the agent would ignore.
"""

_SentMessage = tuple[float, tuple[int, str, int]]
"""A sent message: the mission second, and the message as (sender, type, sequence number)."""

MAX_CHANCE = 1e-12
"""Probability below which the checker considers an observation impossible."""


@dataclass
class _ExpectedDeliveries:
    """The messages that one receiver would handle in a network without loss, and the number that it really handled."""

    messages: int = 0
    """Number of messages that the receiver would handle in a network without loss."""
    least: float = 0.0
    """Lower bound of the number of lost messages: the sum of the smallest loss probabilities (0 to 1) that the records
    allow for these messages.
    """
    most: float = 0.0
    """Upper bound of the number of lost messages: the sum of the largest loss probabilities (0 to 1) that the records
    allow for these messages.
    """
    handled: int = 0
    """Number of these messages that the receiver handled."""
    dropped: int = 0
    """Recorded datagrams that arrived at the receiver, but that the receiver did not handle. Some of these datagrams
    may be among `messages`.
    """

    def loss_range(self) -> tuple[float, float]:
        """Return the smallest and the largest possible mean loss probability of these messages."""
        return self.least / self.messages, self.most / self.messages

    def pass_range(self) -> tuple[float, float]:
        """Return the smallest and the largest possible mean probability that these messages arrive."""
        return 1 - self.most / self.messages, 1 - self.least / self.messages

    def add(self, losses: tuple[float, float]) -> None:
        self.messages += 1
        self.least += losses[0]
        self.most += losses[1]


class _LossHistory:
    """The probability that a link loses a message together with its duplicates, at each time of the run."""

    def __init__(
        self,
        link_losses: list[tuple[float, dict[Link, float]]],
        requested: list[tuple[float, NetworkConditions]],
        slack_s: float,
    ) -> None:
        self._slack_s = slack_s
        self._times: dict[Link, list[float]] = defaultdict(list)
        self._losses: dict[Link, list[float]] = defaultdict(list)
        for at_s, losses in link_losses:
            for link, loss in losses.items():
                self._times[link].append(at_s)
                self._losses[link].append(loss)
        self._changed_at = [at_s for at_s, _ in requested]
        single = [[1 - link.duplicate for link in conditions.all_links()] for _, conditions in requested]
        # The smallest and largest probability that a link sends no second copy, from each of `_changed_at` on:
        self._fewest = [min(shares) for shares in single]
        self._most = [max(shares) for shares in single]
        self._ranges: dict[tuple[Link, int, int, int, int], tuple[float, float]] = {}
        """A cache of the results of `range_at`. The key consists of the link and of the values that are in effect."""

    def range_at(self, link: Link, sent_s: float) -> tuple[float, float]:
        """Return the smallest and the largest probability that the link loses a message, sent at `sent_s`, together
        with its duplicates. The probability may have changed around this time, and the clocks of agents and harness may
        differ by `slack_s`.
        """
        earliest, latest = sent_s - self._slack_s, sent_s + self._slack_s
        times, changed_at = self._times[link], self._changed_at
        first, end = bisect_right(times, earliest), bisect_right(times, latest)
        first_change, end_change = bisect_right(changed_at, earliest), bisect_right(changed_at, latest)
        key = link, first, end, first_change, end_change
        if (known := self._ranges.get(key)) is not None:
            return known
        losses = self._around(self._losses[link], first, end)
        fewest = min(self._around(self._fewest, first_change, end_change))
        most = max(self._around(self._most, first_change, end_change))
        # No copy passes a partition, but a second copy passes a link that loses every first copy.
        highest = max(losses)
        found = self._ranges[key] = min(losses) * fewest, highest if highest == 1.0 else highest * most
        return found

    def _around(self, values: list[float], first: int, end: int) -> list[float]:
        """Return the values that may have been in effect during an interval. `values` is sorted by time. `first` is the
        number of values that took effect before the beginning of the interval. `end` is the number of values that took
        effect before the end of the interval.
        """
        first = max(0, first - 1)
        return values[first : max(first + 1, end)]


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each receiver that lost more or fewer messages than the recorded loss rates can explain."""
    links = evidence.requested_links
    if not links or not evidence.link_losses or evidence.has_fates or evidence.injected.messages:
        return
    if evidence.has_channel:
        return
    if any(isinstance(link.loss, GilbertElliott) for link in links):
        return  # draws in a burst are not independent
    if any(link.delay or link.rate or link.corrupt for link in links):
        return  # messages are late, or lost for another reason
    if set(evidence.record.roster if evidence.record else ()) - set(evidence.traces):
        return  # messages of an agent without a trace are not on record
    if any(trace.problem or trace.cut_off for trace in evidence.traces.values()):
        return
    sides = (False, True) if all(map(in_virtual_time, evidence.traces.values())) else (False,)
    expected = _expected(evidence)
    alone = [(receiver, "it", seen) for receiver, seen in expected.items()]
    together = [(min(expected), "all agents together", _sum(expected.values()))] if expected else []
    for group in (alone, together):
        found = [each for each in group if _is_impossible_at(each[2], sides)]
        for receiver, subject, seen in found:
            detail = (
                f"{subject} handled {seen.handled} of {seen.messages} messages, but by the recorded loss "
                f"{100 * seen.least / seen.messages:.3g} % of them are lost"
            )
            yield of_agent(receiver, detail, "1")
        if found:
            break
    yield from _compare_counters(evidence, links)


def _sum(expected: Iterable[_ExpectedDeliveries]) -> _ExpectedDeliveries:
    total = _ExpectedDeliveries()
    for seen in expected:
        total.messages += seen.messages
        total.handled += seen.handled
        total.dropped += seen.dropped
        total.least += seen.least
        total.most += seen.most
    return total


def _is_impossible_at(seen: _ExpectedDeliveries, sides: tuple[bool, ...]) -> bool:
    return seen.messages > 0 and any(
        _is_impossible(seen.handled + fewer * seen.dropped, seen.messages, seen.pass_range(), fewer=fewer)
        for fewer in sides
    )


def _expected(evidence: Evidence, over_cuts: tuple[float, float] | None = None) -> dict[int, _ExpectedDeliveries]:
    """Return, for each receiver, the messages that it would handle in a network without loss, together with the
    probability of losing each message.

    `over_cuts` is the smallest and the largest loss probability to use for messages over a cut link. If it is None,
    such messages are lost with probability 1.
    """
    slack = max([SAME_TIME_S, *(slack_s(evidence, trace) for trace in evidence.traces.values())])
    history = _LossHistory(evidence.link_losses, evidence.requested_conditions or [], slack)
    duplicates = any(link.duplicate > 0 for link in evidence.requested_links or ())
    known = {link for _, losses in evidence.link_losses for link in losses}
    expected: dict[int, _ExpectedDeliveries] = {}
    messages: dict[frozenset[str] | None, dict[int, list[_SentMessage]]] = {}
    for receiver, trace in evidence.traces.items():
        seen = expected[receiver] = _ExpectedDeliveries(dropped=trace.dropped().total())
        ready = _ReadyTimes(evidence, receiver) if in_virtual_time(trace) else None
        counted = None if ready is None else ready.counted
        if counted not in messages:
            messages[counted] = _sent(evidence, counted, duplicates)
        triggers = [run.trigger for run in trace.runs if isinstance(run.trigger, MessageTrigger)]
        handled = Counter(
            [
                (trigger.sender, trigger.message, trigger.sequence)
                for trigger in triggers
                if counted is None or trigger.message in counted
            ]
        )
        for sender, sent in messages[counted].items():
            link = sender, receiver
            if link not in known:
                continue
            for sent_s, key in sent:
                if ready is not None and not ready.handles(sent_s):
                    continue
                range_at = history.range_at(link, sent_s)
                seen.add(over_cuts if over_cuts is not None and range_at[1] == 1.0 else range_at)
                if handled[key] > 0:
                    handled[key] -= 1
                    seen.handled += 1
    return expected


def _sent(evidence: Evidence, counted: frozenset[str] | None, duplicates: bool) -> dict[int, list[_SentMessage]]:
    """Return the messages that each agent sent. The result contains only messages of the types in `counted`, or of all
    types if `counted` is None.

    In a network that duplicates messages, a receiver cannot distinguish copies of two messages with the same type and
    sequence number. An agent sends two such messages only if it restarts. The result then contains neither of them.
    """
    return {
        sender: [
            (sent_s, (sender, message, sequence))
            for message, by_sequence in by_type.items()
            if counted is None or message in counted
            for sequence, sent in by_sequence.items()
            if len(sent) == 1 or not duplicates
            for sent_s, _ in sent
        ]
        for sender, by_type in evidence.sendings.items()
    }


class _ReadyTimes:
    """The times at which a simulated agent handles every arriving message whose type is in `counted`. At other times,
    the agent is stopped, or it reconciles and ignores messages.
    """

    def __init__(self, evidence: Evidence, agent_id: int) -> None:
        self.counted = MESSAGES if evidence.delivers_all else NEVER_WITHHELD
        self._latest_s = LATENCY.mean_s + LATENCY.jitter_s
        busy: list[tuple[float, float]] = [(from_s, until_s) for from_s, until_s, _ in stopped(evidence, agent_id, 0.0)]
        for incarnation in () if evidence.delivers_all else evidence.incarnations[agent_id]:
            since: float | None = None
            for run in incarnation.runs:
                if run.state.reconciling and since is None:
                    since = run.t
                elif not run.state.reconciling and since is not None:
                    busy.append((since, run.t))
                    since = None
            if since is not None:
                busy.append((since, inf))
        busy.sort()
        self._starts = [from_s for from_s, _ in busy]
        self._busy_until = [*accumulate((until_s for _, until_s in busy), max)]
        self._end_s = evidence.end_of(agent_id) or 0.0

    def handles(self, sent_s: float) -> bool:
        """Return true if the agent handles a message that was sent at `sent_s`, with the shortest and with the longest
        latency.
        """
        arrives_s = sent_s + self._latest_s
        if arrives_s >= self._end_s:
            return False
        number = bisect_right(self._starts, arrives_s + SAME_TIME_S)
        return number == 0 or self._busy_until[number - 1] < sent_s - SAME_TIME_S


def _compare_counters(evidence: Evidence, links: set[LinkConditions]) -> Iterator[Contradiction]:
    """Yield each receiver for which the kernel lost more or fewer packets than the loss rates can explain.

    The kernel counts lost packets separately from packets that a partition cut. It also counts packets to killed
    vehicles.
    """
    record = evidence.record
    if record is None or record.engine != COUNTS_DATAGRAMS or record.counters is None:
        return
    losses = [link.loss for link in links if isinstance(link.loss, float)]
    flies = any(state.what == RANGE for state in record.network)
    if flies or max(losses) == 1.0:
        return
    expected = _expected(evidence, (min(losses), max(losses)))
    for receiver, seen in expected.items():
        counted = record.counters.receivers.get(str(receiver))
        if counted is None or counted.passed is None or counted.lost is None or not seen.messages:
            continue
        packets = counted.passed + counted.lost
        least, most = seen.loss_range()
        if packets and any(
            _is_impossible(counted.lost, packets, (least, most), fewer=fewer) for fewer in (False, True)
        ):
            detail = (
                f"the kernel lost {counted.lost} of {packets} packets to its vehicle, but the recorded loss is "
                f"{100 * least:.3g} to {100 * most:.3g} %"
            )
            yield of_agent(receiver, detail, "1")


def _is_impossible(count: int, number: int, means: tuple[float, float], *, fewer: bool) -> bool:
    """Return true if chance cannot explain `count` successes in `number` random draws. `means` is a lower and an upper
    bound of the mean probability of a success. If `fewer` is true, the function tests whether there are too few
    successes, otherwise whether there are too many.
    """
    share = min(1.0, count / number)
    mean = min(1.0, max(0.0, means[0] if fewer else means[1]))
    if (share >= mean) if fewer else (share <= mean):
        return False
    return exp(-number * _relative_entropy(share, mean)) < MAX_CHANCE


def _relative_entropy(share: float, mean: float) -> float:
    """Return the relative entropy of two draws with the probabilities `share` and `mean`, in nats. Return infinity if
    `mean` makes `share` impossible.
    """
    if mean in (0.0, 1.0):
        return 0.0 if share == mean else float("inf")
    parts = ((share, mean), (1 - share, 1 - mean))
    return sum(part * log(part / whole) for part, whole in parts if part > 0)
