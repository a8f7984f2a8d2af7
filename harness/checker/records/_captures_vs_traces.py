"""Compare packet captures and the kernel's packet counters with the traces of agents.

An agent writes a message to its trace before it sends the message. If the agent is killed in between, it does not send
the message.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator

from harness.archive.packets.capture_files import Captures
from harness.archive.packets.pcap import INBOUND, OUTBOUND
from harness.checker.evidence import Evidence
from harness.checker.judgement import times
from harness.checker.recorded_inputs import sent_at, spread_of
from harness.checker.records.contradiction import Contradiction, of_agent, slack_s
from ucp.trigger import MessageTrigger

COUNTS_DATAGRAMS = "nftables"
"""Name of the network engine that counts each broadcast once. All other engines also count the packets that the network
duplicated.
"""

Datagrams = Counter[tuple[object, object]]
"""Number of datagrams for each sender and sequence number."""


def compare_captures(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each difference between the packets in a vehicle's capture and the messages in its agent's trace."""
    captures = evidence.captures
    if captures is None:
        return
    left, reached = _seen(captures)
    for capture in captures.used:
        agent_id = capture.vehicle
        trace = evidence.traces.get(agent_id) if agent_id is not None else None
        if agent_id is None or trace is None or trace.problem or capture.comment is None:
            continue
        if capture.dropped != 0 or capture.problems:
            continue  # an incomplete capture proves nothing
        sent: Datagrams = Counter((agent_id, message.seq) for run in trace.runs for message in run.sent)
        unsent = sum((sent - left[agent_id]).values()) - _not_sent(evidence, agent_id)
        if unsent > 0:
            detail = f"{times(unsent)} its trace has a sent message that is missing in the capture of its vehicle"
            yield of_agent(agent_id, detail, "1")
        if untraced := sum((left[agent_id] - sent).values()):
            detail = f"{times(untraced)} the capture of its vehicle has a sent message that is missing in its trace"
            yield of_agent(agent_id, detail, "1", short=True)
        triggers = (run.trigger for run in trace.runs)
        heard = {(each.sender, each.sequence) for each in triggers if isinstance(each, MessageTrigger)}
        if unheard := len(heard - reached[agent_id].keys()):
            detail = f"{times(unheard)} it handled a message that is missing in the capture of its vehicle"
            yield of_agent(agent_id, detail, "1")


def _seen(captures: Captures) -> tuple[dict[int, Datagrams], dict[int, Datagrams]]:
    """Return two tables by vehicle: the datagrams that left the vehicle, and the datagrams that reached it."""
    left: dict[int, Datagrams] = defaultdict(Counter)
    reached: dict[int, Datagrams] = defaultdict(Counter)
    by_number = {capture.number: capture for capture in captures.used}
    for datagram in captures.datagrams:
        for _, place, seen in datagram.sightings():
            capture = by_number.get(place)
            if capture is None or capture.vehicle is None:
                continue
            direction = capture.direction(datagram.sender, seen)
            if direction == OUTBOUND and datagram.sender == capture.vehicle:
                left[capture.vehicle][datagram.sender, datagram.sequence] += 1
            elif direction == INBOUND:
                reached[capture.vehicle][datagram.sender, datagram.sequence] += 1
    return left, reached


def _not_sent(evidence: Evidence, agent_id: int) -> int:
    """Return the number of messages in the agent's trace that the agent perhaps never sent. There are three causes.

    A send may have failed. A killed agent does not send the messages of its last handler run. An agent that ends does
    not send the answers that it had delayed.
    """
    recorded = evidence.recorded(agent_id)
    incarnations = evidence.incarnations[agent_id]
    killed = incarnations if recorded is None or recorded.outcome != "exported" else incarnations[:-1]
    last = sum(len(run.sent) for incarnation in killed for run in incarnation.runs if run.t == incarnation.runs[-1].t)
    if spread_s := spread_of(evidence.traces[agent_id]):
        ends = [(incarnation.runs, incarnation.runs[-1].t) for incarnation in incarnations if incarnation.runs]
        last += sum(
            run.t < end_s <= sent_at(run, message, spread_s)
            for runs, end_s in ends
            for run in runs
            if run.t >= end_s - spread_s
            for message in run.sent
        )
    return last + evidence.send_failures(agent_id)


def compare_counters(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each agent for which the kernel counted fewer packets than the traces show as sent or handled.

    On a shared channel, datagrams bypass the engine that counts packets. The function then yields nothing.
    """
    record = evidence.record
    if evidence.has_channel:
        return
    if record is None or record.engine != COUNTS_DATAGRAMS or record.mission_s is None:
        return
    if set(record.roster) - set(evidence.traces) or any(remote.incomplete for remote in record.remote.values()):
        return  # not all messages of these agents are on record, or not all losses of their messages
    sent = {agent_id: _sent_by(evidence, agent_id, record.mission_s) for agent_id in evidence.traces}
    for agent_id, trace in evidence.traces.items():
        counted = record.counters.receivers.get(str(agent_id)) if record.counters else None
        if counted is None or counted.passed is None or counted.lost is None or counted.cut is None:
            continue
        by = record.mission_s - slack_s(evidence, trace)
        heard = sum(isinstance(run.trigger, MessageTrigger) for run in trace.runs if run.t < by)
        if heard > counted.passed:
            detail = f"it handled {heard} messages, but the kernel counted {counted.passed} messages to its vehicle"
            yield of_agent(agent_id, detail, "1")
        on_the_way = sum(messages for sender, messages in sent.items() if sender != agent_id)
        if on_the_way > (counted_messages := counted.passed + counted.lost + counted.cut):
            detail = (
                f"the other agents sent {on_the_way} messages, but the counters of the kernel for its vehicle have "
            )
            yield of_agent(agent_id, f"{detail}{counted_messages}", "1")


def _sent_by(evidence: Evidence, agent_id: int, mission_s: float) -> int:
    """Return the number of messages that the agent had certainly sent when the kernel's counters were read."""
    trace = evidence.traces[agent_id]
    by = mission_s - slack_s(evidence, trace)
    spread_s = spread_of(trace)
    sent = (sent_at(run, message, spread_s) for run in trace.runs for message in run.sent)
    return sum(sent_s < by for sent_s in sent) - _not_sent(evidence, agent_id)
