"""Compare the number of datagrams that the kernel delivered to an agent with the datagrams in traces.

A trace has a line for each datagram that its agent handled or dropped. The agent also reads its own broadcasts, which
it ignores. If the agent read more datagrams than these, its trace is incomplete. A datagram that was read at the end of
an incarnation may be missing, because the agent ended before it handled the datagram. An agent may also use other
sockets, for example between its processes, so only broadcasts count.

An agent that stops reading its socket also has a trace that looks complete. The module therefore uses the kernel's
count of broadcasts that arrived at each vehicle. If neither the agent read a broadcast nor the kernel discarded it, the
broadcast is still in the socket.

`compare_channel` compares the log of a shared radio channel with run.json and with the traces. Until the final
reconcile, messages reach an agent only over the channel. Two messages of a restarted sender can have the same sequence
number, so the messages of this sender are not compared.
"""

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator
from math import inf

from harness.archive.run_journals import ChannelLine
from harness.archive.run_record import ChannelRecord, DatagramsRead
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.judgement import times
from harness.checker.records.contradiction import Contradiction, of_agent
from ucp.trigger import MessageTrigger

UNDER_WAY_WALL_S = 0.25
"""Length of the interval before an agent stops, in seconds of wall time. The agent may not have handled a datagram that
it read in this interval.
"""
UNREAD_WALL_S = 1.0
"""Length of the interval before an agent stops, in seconds of wall time. The agent may not have read a datagram that
the kernel delivered in this interval.
"""


def find_unrecorded(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each agent that read datagrams from its socket but recorded them neither as handled nor as dropped."""
    record = evidence.record
    if record is None or set(record.roster) - set(evidence.traces):
        return
    if evidence.sent_without_trace:
        return
    for agent_id, trace in evidence.traces.items():
        counted = record.datagrams.get(str(agent_id))
        if counted is None or trace.problem or not trace.header.has_inputs:
            continue
        if evidence.describe_unknown_name("trigger", agent_id=agent_id):
            continue
        if evidence.injected.messages and _killed_at(evidence, agent_id):
            continue  # the datagrams of a rogue node may have been under way
        handled = sum(isinstance(run.trigger, MessageTrigger) for run in trace.runs)
        dropped = trace.dropped().total()
        own = sum(len(run.sent) for run in trace.runs)
        read = counted.read - counted.before_start - counted.others
        unrecorded = read - handled - dropped - own
        if unrecorded > _at_the_end(evidence, agent_id, trace, UNDER_WAY_WALL_S):
            yield of_agent(agent_id, _sentence(counted, unrecorded, handled, dropped, own), short=True)


def find_unread(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each agent that left datagrams unread in its socket although it was not paused."""
    record = evidence.record
    if record is None or set(record.roster) - set(evidence.traces):
        return
    for agent_id, trace in evidence.traces.items():
        counted = record.datagrams.get(str(agent_id))
        if counted is None or (evidence.injected.messages and _killed_at(evidence, agent_id)):
            continue
        ends = [*_killed_at(evidence, agent_id), evidence.end_of(agent_id) or 0.0]
        if any(evidence.was_paused(agent_id, end - _mission_s(trace, UNREAD_WALL_S), end) for end in ends):
            continue
        unread = counted.broadcasts - counted.read - counted.overflowed - counted.unreachable
        if unread > _at_the_end(evidence, agent_id, trace, UNREAD_WALL_S):
            detail = f"{unread} of {counted.broadcasts} datagrams that arrived were left unread in its socket"
            yield of_agent(agent_id, detail)


def _sentence(counted: DatagramsRead, unrecorded: int, handled: int, dropped: int, own: int) -> str:
    plural = "s" if unrecorded > 1 else ""
    return (
        f"it read {unrecorded} datagram{plural} that its trace lacks: the kernel counted {counted.read} datagrams that "
        f"it read, but its trace has {handled} handled and {dropped} dropped ones, and it sent {own} itself"
    )


def _at_the_end(evidence: Evidence, agent_id: int, trace: Trace, wall_s: float) -> int:
    """Return the maximum number of datagrams that were in transit to the agent when it stopped, added over all its
    stops.
    """
    before_s = _mission_s(trace, wall_s)
    ends = _killed_at(evidence, agent_id)
    if (last_s := evidence.end_of(agent_id)) is not None:
        ends.append(last_s)
    sent = evidence.cached(_sent_at)
    return sum(1 + bisect_right(sent, end + before_s) - bisect_left(sent, end - before_s) for end in set(ends))


def _mission_s(trace: Trace, wall_s: float) -> float:
    speedup = trace.header.clock.get("speedup")
    return wall_s * speedup if isinstance(speedup, int | float) else 0.0


def _killed_at(evidence: Evidence, agent_id: int) -> list[float]:
    faults = evidence.record.faults if evidence.record else ()
    return [fault.at_s for fault in faults if fault.kind.ends_incarnation and agent_id in (fault.agents or ())]


def _sent_at(evidence: Evidence) -> list[float]:
    """Return the mission second of each message that any agent sent, in ascending order."""
    return sorted(run.t for trace in evidence.traces.values() for run in trace.runs for _ in run.sent)


def compare_channel(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each count in run.json that the channel's log contradicts, and each agent that handled a message after the
    channel lost it.
    """
    record, lines = evidence.record, evidence.channel
    if record is None or record.channel is None or not lines:
        return
    if record.outcome == "completed" and record.channel.counts() != _counted(lines):
        yield of_agent(min(record.roster), "run.json and channel.jsonl have different numbers of frames or losses")
    if evidence.has_fates:
        return  # scripted fates deliver messages regardless of losses
    ends_s = record.final_reconcile.at_s if record.final_reconcile else inf
    fates = _fates(lines)
    for agent_id, trace in evidence.traces.items():
        lost = unknown = 0
        for run in trace.runs:
            trigger = run.trigger
            if not isinstance(trigger, MessageTrigger) or run.t >= ends_s or evidence.injected.may_include(trigger):
                continue
            if len(evidence.incarnations.get(trigger.sender, ())) != 1:
                continue
            line = fates.get((trigger.sender, trigger.sequence))
            unknown += line is None
            lost += line is not None and (
                line.dropped is not None or any(agent_id in ids for ids in line.lost.values())
            )
        if lost:
            yield of_agent(agent_id, f"{times(lost)} it handled a message that the channel had lost on its way", "1")
        if unknown:
            yield of_agent(agent_id, f"{times(unknown)} it handled a message that the channel never carried", "1")


def _fates(lines: list[ChannelLine]) -> dict[tuple[int, int], ChannelLine]:
    return {(line.sender, line.sequence): line for line in lines if line.sequence is not None}


def _counted(lines: list[ChannelLine]) -> Counter[tuple[str, int]]:
    """Return the counts that run.json must contain according to the channel's log: the number of all frames, and the
    numbers of lost and dropped messages of each vehicle.
    """
    counted: Counter[tuple[str, int]] = Counter()
    for line in lines:
        if line.dropped is not None:
            counted[line.dropped, line.sender] += 1
            continue
        counted[ChannelRecord.FRAMES, 0] += 1
        for reason, receivers in line.lost.items():
            counted.update((reason, receiver) for receiver in receivers)
    return counted
