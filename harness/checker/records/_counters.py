"""Compare the counters and completed blocks of each agent in run.json with its trace and its export."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from itertools import pairwise

from harness.archive.run_record import AgentRecord, HandlerRuns
from harness.archive.traces import Trace
from harness.checker._trace_replay import ReplayedIncarnation
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding
from harness.checker.records.contradiction import Contradiction, in_virtual_time, of_agent, slack_s
from ucp.messages import Datagram, datagram_bytes
from ucp.secure.envelope import ADDED_BYTES
from ucp.trace import RecordedBytes
from ucp.trigger import BootTrigger

ROUNDED_S = 5e-4
"""Rounding error in seconds of the times in run.json, which have milliseconds."""


def compare_counters_of_run(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each contradiction between the entry of an agent in run.json and the agent's trace or export. The compared
    values are the counters, the flag `idle`, and the way in which the agent ended.
    """
    for agent_id, trace in evidence.traces.items():
        recorded = evidence.recorded(agent_id)
        if recorded is None or trace.problem:
            continue
        incarnations = evidence.incarnations[agent_id]
        yield from _incarnations(agent_id, recorded, incarnations)
        yield from _handler_runs(evidence, agent_id, recorded, trace, incarnations)
        yield from _counted(evidence, agent_id, recorded, trace, incarnations)
        export = evidence.exports.get(agent_id)
        if (
            export is not None
            and recorded.outcome == "exported"
            and recorded.idle not in (None, export.idle)
            and _ran_nothing_since(recorded, incarnations[-1])
        ):
            idle, not_idle = ("idle", "not idle") if recorded.idle else ("not idle", "idle")
            yield of_agent(
                agent_id, f"it was {idle} at the end according to run.json, but {not_idle} according to its export"
            )
        yield from _dropped(agent_id, recorded, trace)
        if trace.cut_off and recorded.outcome == "exported":
            yield of_agent(
                agent_id, "its trace ends in the middle of a line, although the agent ended by itself", short=True
            )


def _ran_nothing_since(recorded: AgentRecord, incarnation: ReplayedIncarnation) -> bool:
    """Return true if the agent ran no handler after it last reported its counters to the harness."""
    counted = recorded.handler_runs[-1] if recorded.handler_runs else None
    return counted is None or counted.counted == len(incarnation.runs)


def _incarnations(
    agent_id: int, recorded: AgentRecord, incarnations: list[ReplayedIncarnation]
) -> Iterator[Contradiction]:
    expected = 1 + recorded.restarts + recorded.reboots
    if len(incarnations) != expected:
        detail = (
            f"its trace has {_count(len(incarnations), 'header')}, but it started {_count(expected, 'time')} according "
            "to run.json"
        )
        yield of_agent(agent_id, detail, short=len(incarnations) < expected)


def _handler_runs(
    evidence: Evidence, agent_id: int, recorded: AgentRecord, trace: Trace, incarnations: list[ReplayedIncarnation]
) -> Iterator[Contradiction]:
    """Yield a contradiction if the number of lines in the trace differs from the number of handler runs that the agent
    counted.
    """
    expected = 1 + recorded.restarts + recorded.reboots
    if len(recorded.handler_runs) not in (0, expected):
        counts = _count(len(recorded.handler_runs), "count")
        yield of_agent(
            agent_id, f"run.json has {counts} of its handler runs, but it started {_count(expected, 'time')}"
        )
    if len(recorded.handler_runs) != len(incarnations):
        return  # the agent counts none, or incarnations are missing
    for incarnation, counted in zip(incarnations, recorded.handler_runs, strict=True):
        if counted is None:
            continue
        at_least, at_most = _lines_by(evidence, incarnation, counted)
        if not at_least <= counted.counted <= at_most:
            lines = at_most if counted.counted > at_most else at_least
            detail = (
                f"the agent had counted {_count(counted.counted, 'handler run')} at {counted.until_s:g} s, but its "
                f"trace has {_count(lines, 'line')} by then"
            )
            yield of_agent(agent_id, detail, "1", short=counted.counted > at_most)


def _lines_by(evidence: Evidence, incarnation: ReplayedIncarnation, counted: HandlerRuns) -> tuple[int, int]:
    """Return the minimum and maximum number of trace lines that the agent can have written when it reported its
    counters. The two numbers differ, because the time of the report is known only approximately.
    """
    if in_virtual_time(incarnation.trace):
        return len(incarnation.runs), len(incarnation.runs)
    slack = ROUNDED_S + (slack_s(evidence, incarnation.trace) if counted.from_s < counted.until_s else 0.0)
    return (
        bisect_left(incarnation.runs, counted.from_s - slack, key=lambda run: run.t),
        bisect_right(incarnation.runs, counted.until_s + slack, key=lambda run: run.t),
    )


def _counted(
    evidence: Evidence, agent_id: int, recorded: AgentRecord, trace: Trace, incarnations: list[ReplayedIncarnation]
) -> Iterator[Contradiction]:
    """Compare the counters in run.json with the traces. Each counter is the sum over all incarnations of the agent (the
    times between its restarts).
    """
    sent = sum(incarnation.sent for incarnation in incarnations)
    if recorded.messages_sent is not None and recorded.messages_sent != sent:
        detail = (
            f"it sent {_count(recorded.messages_sent, 'message')} according to run.json, but {sent} according to "
            "its trace"
        )
        yield of_agent(agent_id, detail, "1")
    if (failures := recorded.send_failures or 0) > sent:
        detail = f"it could not send {failures} messages according to run.json, but its trace has only {sent}"
        yield of_agent(agent_id, detail, "1")
    is_traced = trace.header.has_inputs and not evidence.sent_without_trace
    sent_bytes = _bytes_sent(trace) if is_traced else None
    if sent_bytes is not None and recorded.bytes_sent is not None and recorded.bytes_sent > sent_bytes:
        yield of_agent(
            agent_id,
            f"it sent {recorded.bytes_sent} bytes according to run.json, but {sent_bytes} according to its trace",
            "1",
        )
    if recorded.reconciles is not None and not evidence.describe_unknown_name("handler", "branch", agent_id=agent_id):
        begun = len([run for run in trace.runs if run.handler == "reconcile_begin" and run.branch == "begun"])
        if recorded.reconciles != begun:
            detail = (
                f"it began {_count(recorded.reconciles, 'reconcile')} according to run.json, but {begun} "
                "according to its trace"
            )
            yield of_agent(agent_id, detail)
    if recorded.chain_changed_at_s is not None and not any(incarnation.unknown for incarnation in incarnations):
        changed_at_s = _chain_changed_at(incarnations[-1])
        if abs(recorded.chain_changed_at_s - changed_at_s) > ROUNDED_S + slack_s(evidence, trace):
            detail = (
                f"its chain changed last at {recorded.chain_changed_at_s:g} s according to run.json, but at "
                f"{changed_at_s:g} s according to its trace"
            )
            yield of_agent(agent_id, detail)


def _bytes_sent(trace: Trace) -> int:
    """Return the total size of all sent datagrams in a trace."""
    added = ADDED_BYTES if trace.header.secured else {}
    sent = [message for run in trace.runs for message in run.sent]
    return sum([_bytes(message.datagram) + added.get(message.message, 0) for message in sent if message.datagram])


def _bytes(datagram: RecordedBytes) -> int:
    """Return the size of a datagram in bytes. It is computed from the length of the base64 text."""
    if isinstance(datagram.content, Datagram):
        return datagram_bytes(datagram.content.message)
    return len(datagram.text) // 4 * 3 - datagram.text.count("=", -2)


def _dropped(agent_id: int, recorded: AgentRecord, trace: Trace) -> Iterator[Contradiction]:
    """Yield a contradiction if the trace has fewer lines about dropped datagrams than the agent counted."""
    if recorded.dropped is None or not trace.header.has_inputs:
        return
    traced = trace.dropped()
    for reason, count in recorded.dropped.items():
        if traced[reason] < count:
            detail = (
                f"it dropped {_count(count, 'datagram')} ({reason}) according to run.json, but {traced[reason]} "
                "according to its trace"
            )
            yield of_agent(agent_id, detail, short=True)


def _chain_changed_at(incarnation: ReplayedIncarnation) -> float:
    for run in reversed(incarnation.runs):
        if any(operation.startswith("chain") for operation, _ in run.changes):
            return run.t
    return 0.0


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number != 1 else ''}"


def compare_completed_blocks(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each difference between the completed blocks (and their order) in the trace, the export and run.json."""
    for agent_id, incarnations in evidence.incarnations.items():
        if evidence.traces[agent_id].problem or any(incarnation.unknown for incarnation in incarnations):
            continue
        yield from _over_brown_outs(evidence, agent_id, incarnations)
        traced = dict.fromkeys(block for incarnation in incarnations for block in incarnation.completed)
        export, recorded = evidence.exports.get(agent_id), evidence.recorded(agent_id)
        exported = export.completed if export else []
        before = recorded.completed_before if recorded else []
        for source, blocks in (("its export", exported), ("run.json", before)):
            untraced = [block for block in blocks if block not in traced]
            if untraced:
                detail = (
                    f"it completed {_named(evidence, untraced)} according to {source}, but not according to its trace"
                )
                yield _of_block(evidence, agent_id, detail, untraced[0], short=True)
        if recorded is not None and (recorded.outcome == "killed" or (recorded.outcome == "exported" and export)):
            reported = {*exported, *before}
            if unreported := [block for block in traced if block not in reported]:
                named = _named(evidence, unreported)
                detail = f"it completed {named} according to its trace, but not according to its export"
                yield _of_block(evidence, agent_id, detail, unreported[0])
        if export is not None and _out_of_order(exported, incarnations[-1].completed):
            detail = "its export and its trace list its completed blocks in different order"
            yield _of_block(evidence, agent_id, detail, exported[0])


def _over_brown_outs(
    evidence: Evidence, agent_id: int, incarnations: list[ReplayedIncarnation]
) -> Iterator[Contradiction]:
    """Compare the completed blocks before and after each restart after a power failure. Yield a contradiction if the
    agent's disk lacked completed blocks. The disk may contain one additional block, because the last trace line before
    the power failure may be missing.
    """
    for before, after in pairwise(incarnations):
        if not after.runs or not isinstance(after.runs[0].trigger, BootTrigger):
            continue
        restored = [block for operation, block in after.runs[0].changes if operation == "complete"]
        if restored[: len(before.completed)] != before.completed:
            lost = next((block for block in before.completed if block not in restored), before.completed[0])
            detail = f"at {after.runs[0].t:g} s it restarts with other completed blocks than it had when it stopped"
            yield _of_block(evidence, agent_id, detail, lost)


def _out_of_order(exported: list[str], traced: list[str]) -> bool:
    """Return true if the two lists have their common blocks in different orders, or if one list contains a common block
    more often.
    """
    both = {*exported} & {*traced}
    return [block for block in exported if block in both] != [block for block in traced if block in both]


def _of_block(evidence: Evidence, agent_id: int, detail: str, block_hash: str, *, short: bool = False) -> Contradiction:
    return Contradiction(Finding(agent_id, detail, evidence.name(block_hash), block_hash), "5", short)


def _named(evidence: Evidence, blocks: list[str]) -> str:
    if len(blocks) == 1:
        return f"block {evidence.name(blocks[0])}"
    return f"{len(blocks)} blocks, {evidence.name(blocks[0])} the first"
