"""Compare the share of lost messages with the loss rate that the network was set to.

Each receiver of a message loses it independently, with a known probability. The number of lost messages is therefore a
sum of independent draws. By Hoeffding's bound (1963, Theorem 1) the probability that the share of n draws is a or more,
at a mean of q < a, is at most exp(-n KL(a, q)), where KL is the relative entropy of two draws. The same holds below the
mean. A share contradicts the records only if its probability is below `MAX_CHANCE`, so that chance practically never
causes a contradiction.

Only messages count that a correct agent handles if they arrive:

- With processes and containers: all messages. Their agents may handle fewer messages than arrive, because they were
  stopped or a socket was full. Handled messages therefore contradict the loss rate only if there are too many. An
  engine that counts packets shows whether too few or too many were lost.
- In virtual time: three types of messages, to an agent that runs and does not reconcile. Virtual time withholds other
  messages if they have no effect.
"""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import exp, inf, log

from harness.archive.connectivity import Link
from harness.checker._sent_times import sent_at, spread_of
from harness.checker.evidence import Evidence
from harness.checker.records._captures_vs_traces import COUNTS_DATAGRAMS
from harness.checker.records._handled_vs_faults import stopped
from harness.checker.records.contradiction import Contradiction, in_virtual_time, of_agent, slack_s
from harness.scenario.changes import RANGE
from harness.scenario.faults.fault import SAME_TIME_S
from netem.link import GilbertElliott, LinkConditions
from netem.medium import LATENCY
from ucp.messages import BlockAddRequest, ChainContainQuery, CommitBlock
from ucp.trigger import MessageTrigger

NEVER_WITHHELD = frozenset(message.NAME for message in (BlockAddRequest, CommitBlock, ChainContainQuery))
"""Messages that virtual time delivers to each agent that does not reconcile. Others it withholds without effect."""

MAX_CHANCE = 1e-12
"""Highest probability of an observation that counts as impossible."""


@dataclass
class _ExpectedDeliveries:
    """The messages to one receiver: their number, and the sums of their smallest and largest loss probabilities."""

    messages: int = 0
    least: float = 0.0
    most: float = 0.0
    handled: int = 0

    def loss_range(self) -> tuple[float, float]:
        """Return the smallest and the largest possible mean loss rate of these messages."""
        return self.least / self.messages, self.most / self.messages

    def pass_range(self) -> tuple[float, float]:
        """Return the smallest and the largest possible mean probability that one of these messages arrives."""
        return 1 - self.most / self.messages, 1 - self.least / self.messages

    def add(self, losses: tuple[float, float]) -> None:
        self.messages += 1
        self.least += losses[0]
        self.most += losses[1]


class _LossHistory:
    """The loss rate of each link over time."""

    def __init__(self, link_losses: list[tuple[float, dict[Link, float]]], slack_s: float) -> None:
        self._slack_s = slack_s
        self._times: dict[Link, list[float]] = defaultdict(list)
        self._losses: dict[Link, list[float]] = defaultdict(list)
        for at_s, losses in link_losses:
            for link, loss in losses.items():
                self._times[link].append(at_s)
                self._losses[link].append(loss)

    def range_at(self, link: Link, sent_s: float) -> tuple[float, float]:
        """Return the smallest and the largest loss rate of the link between shortly before and shortly after
        this time.
        """
        times, losses = self._times[link], self._losses[link]
        if len(losses) == 1:
            return losses[0], losses[0]
        first = max(0, bisect_right(times, sent_s - self._slack_s) - 1)
        last = max(first + 1, bisect_right(times, sent_s + self._slack_s))
        return min(losses[first:last]), max(losses[first:last])


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each receiver that lost more or fewer messages than the recorded loss rates can explain."""
    links = evidence.requested_links
    if not links or not evidence.link_losses or evidence.has_fates or evidence.injected.messages:
        return
    if evidence.has_channel:
        return
    if any(isinstance(link.loss, GilbertElliott) for link in links):
        return  # draws in a burst are not independent
    if any(link.delay or link.rate or link.corrupt or link.duplicate for link in links):
        return  # messages are late, lost for another reason, or pass as a second copy although the first is lost
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
                f"{subject} handled {seen.handled} of {seen.messages} messages, but the recorded loss is "
                f"{100 * seen.least / seen.messages:.3g} %"
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
        total.least += seen.least
        total.most += seen.most
    return total


def _is_impossible_at(seen: _ExpectedDeliveries, sides: tuple[bool, ...]) -> bool:
    return seen.messages > 0 and any(
        _is_impossible(seen.handled, seen.messages, seen.pass_range(), fewer=fewer) for fewer in sides
    )


def _expected(evidence: Evidence, over_cuts: tuple[float, float] | None = None) -> dict[int, _ExpectedDeliveries]:
    """Return, for each receiver, the number of messages that a correct agent handles if they arrive, with their loss
    probabilities.

    If `over_cuts` is given, it contains the smallest and the largest loss probability of a message whose link is cut.
    """
    slack = max([SAME_TIME_S, *map(slack_s, evidence.traces.values())])
    history = _LossHistory(evidence.link_losses, slack)
    known = {link for _, losses in evidence.link_losses for link in losses}
    expected: dict[int, _ExpectedDeliveries] = {}
    for receiver, trace in evidence.traces.items():
        seen = expected[receiver] = _ExpectedDeliveries()
        triggers = [run.trigger for run in trace.runs if isinstance(run.trigger, MessageTrigger)]
        handled = Counter((trigger.sender, trigger.message, trigger.sequence) for trigger in triggers)
        ready = _ReadyTimes(evidence, receiver) if in_virtual_time(trace) else None
        for sender, of_sender in evidence.traces.items():
            if (sender, receiver) not in known:
                continue
            spread_s = spread_of(of_sender)
            for run in of_sender.runs:
                for message in run.sent:
                    if ready is not None and not ready.handles(message.message, run.t):
                        continue
                    range_at = history.range_at((sender, receiver), sent_at(run, message, spread_s))
                    seen.add(over_cuts if over_cuts is not None and range_at[1] == 1.0 else range_at)
                    key = sender, message.message, message.seq
                    if handled[key] > 0:
                        handled[key] -= 1
                        seen.handled += 1
    return expected


class _ReadyTimes:
    """The times at which an agent in virtual time would handle a message of certain types if it arrived."""

    def __init__(self, evidence: Evidence, agent_id: int) -> None:
        self._latest_s = LATENCY.mean_s + LATENCY.jitter_s
        busy: list[tuple[float, float]] = [(from_s, until_s) for from_s, until_s, _ in stopped(evidence, agent_id, 0.0)]
        for incarnation in evidence.incarnations[agent_id]:
            since: float | None = None
            for run in incarnation.runs:
                if run.state.reconciling and since is None:
                    since = run.t
                elif not run.state.reconciling and since is not None:
                    busy.append((since, run.t))
                    since = None
            if since is not None:
                busy.append((since, inf))
        self._busy = sorted(busy)
        self._starts = [from_s for from_s, _ in self._busy]
        self._end_s = evidence.end_of(agent_id) or 0.0

    def handles(self, message: str, sent_s: float) -> bool:
        """Return true if the agent would handle the message at every possible time of its arrival."""
        arrives_s = sent_s + self._latest_s
        if message not in NEVER_WITHHELD or arrives_s >= self._end_s:
            return False
        number = bisect_right(self._starts, arrives_s + SAME_TIME_S)
        return all(until_s < sent_s - SAME_TIME_S for _, until_s in self._busy[max(0, number - 2) : number])


def _compare_counters(evidence: Evidence, links: set[LinkConditions]) -> Iterator[Contradiction]:
    """Yield each receiver for which the kernel lost more or fewer packets than the loss rates can explain.

    The kernel counts packets that a partition cut separately from lost packets. It counts packets to a killed vehicle
    like any others.
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
    """Return true if this count, or a more extreme one, is practically impossible in `number` random draws.

    `means` contains the smallest and the largest possible mean of the draws.
    """
    share = min(1.0, count / number)
    mean = min(1.0, max(0.0, means[0] if fewer else means[1]))
    if (share >= mean) if fewer else (share <= mean):
        return False
    return exp(-number * _relative_entropy(share, mean)) < MAX_CHANCE


def _relative_entropy(share: float, mean: float) -> float:
    """Return the relative entropy of `share` and `mean` in nats, or infinity if the share is impossible."""
    if mean in (0.0, 1.0):
        return 0.0 if share == mean else float("inf")
    parts = ((share, mean), (1 - share, 1 - mean))
    return sum(part * log(part / whole) for part, whole in parts if part > 0)
