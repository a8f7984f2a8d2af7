"""Compare the number of datagrams that the kernel delivered to an agent with the datagrams in traces.

A trace has a line for each datagram that its agent handled or dropped. The agent also reads its own broadcasts, which
it ignores. If the agent read any other datagram, its trace is incomplete. There are two exceptions. An agent may end
before it handles a datagram that it has just read, so datagrams that arrived shortly before the end may be missing. An
agent may also use other sockets, for example between its processes, so only broadcasts count.

If an agent stops reading its socket, its trace looks complete, although it did not handle all datagrams. The module
therefore also uses the kernel's count of broadcasts that arrived at each vehicle. A broadcast that neither the agent
read nor the kernel discarded is still in the socket.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

from harness.archive.run_record import DatagramsRead
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import Contradiction, of_agent
from ucp.trigger import MessageTrigger

UNDER_WAY_WALL_S = 0.25
"""Maximum number of seconds of wall time from reading a datagram until handling it. If the agent stops within this
time, it may have read the datagram without handling it.
"""
UNREAD_WALL_S = 1.0
"""Maximum number of seconds of wall time from the arrival of a datagram until the agent reads it. If the agent stops
within this time, the datagram may stay unread.
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
    """Yield each agent that left datagrams unread in its socket although it was running."""
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
    """Return the maximum number of datagrams that an agent may have left unhandled or unread because it stopped. The
    result is a sum over all stops of the agent. It counts the datagrams that any agent sent at most `wall_s` seconds of
    wall time before or after a stop, and one more for each stop.
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
