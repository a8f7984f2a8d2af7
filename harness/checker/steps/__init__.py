"""Compare each handler run of each agent with Algorithms 1 to 20.

The judge gives the recorded inputs of each agent, step by step, to the independent reference
(`harness.checker.reference`). It compares branch, changes, messages, timers, vote counts and state. It needs only the
recorded files of a run, so it judges agents in any language, and an edit of `ucp` does not change it. After a
difference the judge continues from the agent's own state, so one mistake gives one finding.
"""

from collections import Counter
from dataclasses import replace
from itertools import islice

from harness.archive.traces import Trace
from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, unknown_names
from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, Judgement, agents, times
from harness.checker.recorded_inputs import BlockIndex, decoded
from harness.checker.records import cross_examine
from harness.checker.reference import why_not_handled
from harness.checker.reference.algorithms import HANDLERS, ON_MESSAGE
from harness.checker.steps import _shared_code
from harness.checker.steps._late_timers import JudgedTimers
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.end_of_record import crashes, failure
from harness.checker.steps.follower import OptionalTraceFields, StepComparer
from harness.checker.steps.trace_header import CheckedHeader, ImpossibleHeaderError, UnknownSettingError, checked
from ucp.messages import MalformedDatagramError
from ucp.trace import CommandEntry, DroppedDatagram

NAME = "every step"


def first_cause(judgement: Judgement | None) -> str | None:
    """Return the cause of the verdict `deviates`: the name of the first handler that deviates, or the names of the
    edited files that the judge and the agents share. Return None for any other verdict, or if the cause is unknown.
    """
    if judgement is None or judgement.verdict != "deviates":
        return None
    return _shared_code.broken_files() or next((finding.handler for finding in judgement.evidence), None)


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on all steps: `deviates` after any difference from the reference, `not applicable` if a step
    could not be judged, and `as specified` otherwise.

    The judge and the agents share some code, such as the codec of messages. The verdict is also `deviates` if an edit
    broke this code, because the judge then cannot be trusted.
    """
    judgement = _compare(evidence) if evidence.steps is None else evidence.steps
    if (defect := _shared_code.defect()) is not None:
        also = f"; {judgement.reason}" if judgement.verdict == "deviates" else ""
        return replace(judgement, verdict="deviates", reason=f"{defect}{also}")
    if (files := " and ".join(_shared_code.edited())) and judgement.verdict == "as specified":
        remark = f"the judge uses {files} too, which was edited and follows the test vectors"
        return replace(judgement, reason=f"{judgement.reason}; {remark}")
    return judgement


def _compare(evidence: Evidence) -> Judgement:
    """Return the verdict on all steps. The caller has checked that the shared code is intact."""
    blocks = BlockIndex(block for export in evidence.exports.values() for block in export.blocks())
    deviations: list[StepDeviation] = []
    timers = JudgedTimers()
    steps, unjudged, lost = 0, dict[int, str](), list[str]()
    for number, (agent_id, trace) in enumerate(evidence.traces.items(), 1):
        evidence.report_progress(f"judging the steps of agent {agent_id}, trace {number} of {len(evidence.traces)}")
        if not trace.header.has_inputs:
            unjudged[agent_id] = "the trace has the version ucp-trace/1, which lacks received messages"
            continue
        try:
            header = checked(trace.header)
        except UnknownSettingError as error:
            unjudged[agent_id] = str(error)
            continue
        except ImpossibleHeaderError as error:
            deviations.append(StepDeviation(agent_id, 1, 0.0, None, str(error)))
            continue
        followers = _followers(evidence, trace, header, blocks)
        _follow(evidence, agent_id, trace, followers)
        deviations += [deviation for follower in followers for deviation in follower.deviations]
        deviations += timers.judge(evidence, trace, [expiry for follower in followers for expiry in follower.expiries])
        for line, aside in trace.numbered_asides():
            if (deviation := wrongly_dropped(header, line, aside)) is not None:
                deviations.append(deviation)
        lost += [follower.lost for follower in followers if follower.lost]
        recorded = evidence.recorded(agent_id)
        crashed = crashes(trace, recorded)
        deviations += crashed
        if not crashed and (why := failure(recorded)) is not None:
            unjudged[agent_id] = why
        steps += len(trace.runs)
    if deviations:
        return deviates(evidence, deviations, steps, lost)
    for agent_id in sorted(set(evidence.roster or evidence.exports) - set(evidence.traces)):
        unjudged[agent_id] = "there is no trace"
    for agent_id, words in evidence.unknown.items():
        unjudged.setdefault(agent_id, f"the trace has unknown words: {first_unknown(words)}")
    unjudged |= {
        agent_id: f"the trace is incomplete: {why}" for agent_id, why in evidence.cached(cross_examine).short.items()
    }
    if unjudged or not evidence.traces:
        return Judgement(NAME, "not applicable", _reason_not_judged(unjudged))
    return Judgement(NAME, "as specified", f"{steps} handler runs, each following Algorithms 1 to 20{timers.remark}")


def _reason_not_judged(unjudged: dict[int, str]) -> str:
    if not unjudged:
        return "the run has no traces, and exports do not show steps"
    by_reason: dict[str, list[int]] = {}
    for agent_id, why in sorted(unjudged.items()):
        by_reason.setdefault(why, []).append(agent_id)
    return "; ".join(f"of {agents(ids)} {why}" for why, ids in by_reason.items())


def _followers(evidence: Evidence, trace: Trace, header: CheckedHeader, blocks: BlockIndex) -> list[StepComparer]:
    """Return a `StepComparer` for each incarnation of the agent (the time between two restarts)."""

    def was_delayed(since: float, until: float) -> bool:
        return evidence.was_delayed(header.agent_id, since, until)

    parts = OptionalTraceFields.of(trace)
    return [StepComparer(header, parts, blocks, was_delayed) for _ in range(len(trace.starts) + 1)]


def _follow(evidence: Evidence, agent_id: int, trace: Trace, followers: list[StepComparer]) -> None:
    """Compare the steps of the agent with the reference. The comparison stops before the first step that contains a
    name that the agent contract does not define, for example of a handler.
    """
    understood = not evidence.unknown.get(agent_id, {}).keys() - IGNORED_KINDS
    for follower, life in zip(followers, trace.incarnations(), strict=True):
        if evidence.watch is not None:
            evidence.watch(follower.state, None)
        for line, run in life:
            if not understood and unknown_names([run]).keys() - IGNORED_KINDS:
                return
            follower.follow(line, run)
            if evidence.watch is not None and follower.lost is None:
                evidence.watch(follower.state, run)
    if agent_id in evidence.exports and not trace.cut_off and not trace.problem:
        followers[-1].end(evidence.end_of(agent_id))


def wrongly_dropped(header: CheckedHeader, line: int, aside: DroppedDatagram | CommandEntry) -> StepDeviation | None:
    """Return a deviation if the agent dropped a datagram that the protocol requires it to handle. Return None
    otherwise.
    """
    if not isinstance(aside, DroppedDatagram) or header.secured:
        return None  # a secured agent drops datagrams before it decrypts them
    try:
        sender, _, message = decoded(aside.datagram)
    except MalformedDatagramError:
        return None
    if why_not_handled(header.agent_id, header.roster, sender, message) is not None:
        return None
    what = f"it dropped a {message.NAME} of agent {sender} as {aside.dropped[:60]!r} and did not handle it"
    return StepDeviation(header.agent_id, line, aside.t, ON_MESSAGE[type(message)].name, what)


def deviates(evidence: Evidence, deviations: list[StepDeviation], steps: int, lost: list[str]) -> Judgement:
    """Return the judgement for the deviations of all agents. `steps` is the number of compared steps. `lost` contains
    the reasons why some steps could not be compared.
    """
    deviations.sort(key=lambda deviation: (deviation.t, deviation.agent_id, deviation.line))
    first_unknown: dict[tuple[int, str | None], StepDeviation] = {}
    for deviation in deviations:
        first_unknown.setdefault((deviation.agent_id, _known(deviation)), deviation)
    counts = Counter((deviation.agent_id, _known(deviation)) for deviation in deviations)
    findings = []
    for (agent_id, handler), deviation in islice(first_unknown.items(), MAX_EVIDENCE):
        more = counts[agent_id, handler] - 1
        again = f"; {times(more)} more later" if more else ""
        findings.append(Finding(agent_id, f"{deviation.sentence(evidence.name)}{again}", handler=handler))
    by_handler = Counter(map(_known, deviations)).most_common()
    differences = f"{len(deviations)} difference{'s' if len(deviations) > 1 else ''} in {steps} handler runs"
    reason = f"{differences}, the first in {_title(_known(deviations[0]))}"
    if len(by_handler) > 1:
        reason += f"; by handler: {', '.join(f'{_title(handler)} {count}' for handler, count in by_handler)}"
    return Judgement(NAME, "deviates", "; ".join([reason, *lost[:MAX_EVIDENCE]]), findings)


def _known(deviation: StepDeviation) -> str | None:
    """Return the name of the handler that deviated. Return None if it is none of the 20 handlers of the protocol."""
    return deviation.handler if deviation.handler in HANDLERS else None


def _title(handler: str | None) -> str:
    """Return the title of a handler, such as "Algorithm 5, vote_timer_expiration"."""
    return f"Algorithm {HANDLERS[handler].algorithm}, {handler}" if handler else "an unknown handler"
