"""Compare the log of a shared radio channel with run.json and with the traces.

Until the final reconcile, messages reach an agent only over the channel. Two messages of a restarted sender can have
the same sequence number, so the messages of this sender are not compared.
"""

from collections import Counter
from collections.abc import Iterator
from math import inf

from harness.archive.run_journals import ChannelLine
from harness.archive.run_record import ChannelRecord
from harness.checker.evidence import Evidence
from harness.checker.judgement import times
from harness.checker.records.contradiction import Contradiction, of_agent
from ucp.trigger import MessageTrigger


def compare(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each count in run.json that the channel's log contradicts. Also yield each agent that handled a message
    that the channel lost or never carried.
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
