"""Compare the handler runs in traces with the faults that stopped agents and the partitions that cut links.

An agent runs no handler while it is killed, rebooting, switched off or paused. If a link loses all messages when the
sender sends a message, the receiver does not handle this message. The time of sending decides, because messages that
are already in transit still arrive.

The harness records a stop after the agent has stopped, and a start before the agent runs again. `CLOCK_SLACK_WALL_S`
therefore covers only the difference between two readings of the machine's clock. Links are different: on a busy
machine, the network conditions may change between the time of a trace line and the sending of its datagram. A message
therefore counts as sent over a cut link only if the link was cut during the whole tolerance interval around the time of
sending.
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterator
from math import inf

from harness.archive.connectivity import Link
from harness.archive.traces import Trace
from harness.checker._trace_replay import TraceObservation
from harness.checker.evidence import Evidence
from harness.checker.records._export_vs_trace import finding
from harness.checker.records.contradiction import ROUNDED_S, Contradiction, in_virtual_time, slack_s
from harness.scenario.faults.fault import SAME_TIME_S
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

CLOCK_SLACK_WALL_S = 0.1
"""Maximum difference between two readings of the machine's clock, in seconds of wall time: one by the harness, one by
an agent.
"""

Stop = tuple[float, float, str]
"""An interval during which an agent was stopped: start and end in mission seconds, and the fault that stopped it.
Exactly at the start and at the end, the agent may run.
"""


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each handler run that the faults of the scenario make impossible: the agent was stopped at that time, or
    the link over which the message came was cut.
    """
    if evidence.record is None:
        return
    cuts = _cuts(evidence)
    for agent_id, trace in evidence.traces.items():
        stops = stopped(evidence, agent_id, _clock_slack_s(evidence, trace))
        if cuts is None and not stops:
            continue
        for incarnation in evidence.incarnations[agent_id]:
            for line, run in incarnation.numbered_runs():
                for what in (_while_stopped(run, stops), _over_a_cut(evidence, agent_id, run, cuts)):
                    if what is not None:
                        yield Contradiction(finding(evidence, agent_id, TraceObservation(line, run, what)), "1")


def _clock_slack_s(evidence: Evidence, trace: Trace) -> float:
    speedup = trace.header.clock.get("speedup")
    remote = evidence.remote(trace.header.agent_id)
    if remote is not None and remote.cut_off:
        return inf  # a fault may have reached it when its connection was back
    if in_virtual_time(trace) or not isinstance(speedup, int | float):
        return SAME_TIME_S
    return SAME_TIME_S + (CLOCK_SLACK_WALL_S + evidence.clock_error_s(trace.header.agent_id)) * speedup


def stopped(evidence: Evidence, agent_id: int, slack_s: float) -> list[Stop]:
    """Return the intervals during which the agent was killed, rebooting, switched off or paused, or had failed. Each
    interval begins `slack_s` later and ends `slack_s` earlier than recorded, so that a small difference of clocks
    causes no finding.
    """
    stops = list(_failed(evidence, agent_id, slack_s))
    since: tuple[float, str] | None = None
    end_s = inf
    for fault in evidence.record.faults if evidence.record else ():
        kind = fault.kind
        if agent_id not in (fault.agents or ()):
            continue
        ends_s = fault.at_s if fault.planned_s is None else min(fault.at_s, fault.planned_s)
        if since is not None and kind.state_after is not None:
            stops.append((since[0] + slack_s, ends_s - slack_s, since[1]))
            since = None
        if kind.ends_incarnation or kind.suspends_agent:
            since = fault.at_s, f"its {kind.what} at {fault.at_s:g} s"
            # The harness wakes a paused agent at the end of the run, for its export.
            end_s = (evidence.ended_at_s or 0.0) - slack_s if kind.suspends_agent else inf
    if since is not None:
        stops.append((since[0] + slack_s, end_s, since[1]))
    return [stop for stop in stops if stop[0] < stop[1]]


def _failed(evidence: Evidence, agent_id: int, slack_s: float) -> Iterator[Stop]:
    """Yield the intervals between a failure of the agent and its next start."""
    recorded = evidence.recorded(agent_id)
    for failed in recorded.failures if recorded else ():
        restarts_s = min(
            (
                fault.at_s
                for fault in (evidence.record.faults if evidence.record else ())
                if agent_id in (fault.agents or ()) and fault.at_s >= failed.at_s and fault.kind.begins_incarnation
            ),
            default=inf,
        )
        yield failed.at_s + slack_s, restarts_s - slack_s, f"its failure at {failed.at_s:g} s"


def _while_stopped(run: HandlerRun, stops: list[Stop]) -> str | None:
    for from_s, until_s, fault in stops:
        if from_s < run.t < until_s:
            return f"ran at {run.t:g} s, although {fault} had stopped the agent"
    return None


class _CutIntervals:
    """The intervals, for each link, in which the link loses all messages."""

    def __init__(self, link_losses: list[tuple[float, dict[Link, float]]], slack_s: float) -> None:
        self.slack_s = slack_s
        self._times: dict[Link, list[float]] = defaultdict(list)
        """Link -> mission seconds at which the link changed. The first change cut the link, the second restored it, and
        so on.
        """
        for at_s, losses in link_losses:
            for link, loss in losses.items():
                times = self._times[link]
                if (loss == 1.0) != (len(times) % 2 == 1):
                    times.append(at_s)

    def cut_at(self, link: Link, sent_s: float) -> bool:
        """Return true if the link was certainly cut at this time: it was cut from `slack_s` before this time until
        `slack_s` after it.
        """
        times = self._times.get(link, [])
        from_s, until_s = sent_s - self.slack_s, sent_s + self.slack_s
        number = bisect_right(times, from_s)
        return number % 2 == 1 and (number == len(times) or until_s < times[number])


def _cuts(evidence: Evidence) -> _CutIntervals | None:
    """Return the intervals in which links lost all messages. Return None if there are no such intervals, or if messages
    may arrive in spite of them.

    Messages may arrive in spite of such an interval in three cases. The scenario decides the fate of each message in
    its section `fates`. The network emulator netem loses the first copy of a message, but passes the second one. On a
    shared channel, a message waits until after the interval.
    """
    if evidence.has_fates or evidence.has_channel or any(link.duplicate > 0 for link in evidence.requested_links or ()):
        return None
    if not any(loss == 1.0 for _, losses in evidence.link_losses for loss in losses.values()):
        return None
    slack = max((slack_s(evidence, trace) for trace in evidence.traces.values()), default=ROUNDED_S)
    return _CutIntervals(evidence.link_losses, max(slack, SAME_TIME_S))


def _over_a_cut(evidence: Evidence, agent_id: int, run: HandlerRun, cuts: _CutIntervals | None) -> str | None:
    trigger = run.trigger
    if cuts is None or not isinstance(trigger, MessageTrigger) or trigger.sender == agent_id:
        return None
    sent = evidence.sendings.get(trigger.sender, {}).get(trigger.message, {}).get(trigger.sequence, ())
    if not sent or not all(cuts.cut_at((trigger.sender, agent_id), sent_s) for sent_s, _ in sent):
        return None
    if evidence.injected.may_include(trigger):
        return None
    return (
        f"handled {trigger.message} number {trigger.sequence}, which agent {trigger.sender} sent at {sent[0][0]:g} s, "
        "although no message could pass this link then"
    )
