"""Compare each handler run of each agent with Algorithms 1 to 20.

The judge gives the recorded inputs of each agent, step by step, to the independent reference
(`harness.checker.reference`). It compares branch, changes, messages, timers, vote counts and state. It needs only the
recorded files of a run, so it judges agents in any language, and an edit of `ucp` does not change it. After a
difference the judge continues from the agent's own state, so one mistake gives one finding.

The module also finds timers that expired later than the measured delays of the machine can explain. A correct agent
runs a timer late only if the machine wakes it late, or if its process is busy or waits for a processor. The harness
measures both delays during a run (`lag.jsonl`). The measured delay is an upper bound, so a single timer reveals only a
large error. If the duration of a timer is wrong, all expiries of this timer are late. Their mean lateness over the run
then reveals smaller errors, too.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from statistics import mean

from harness.archive.traces import Trace
from harness.archive.vocabulary import IGNORED_KINDS, first_unknown, unknown_names
from harness.checker.evidence import Evidence
from harness.checker.judgement import MAX_EVIDENCE, Finding, Judgement, agents, times
from harness.checker.recorded_inputs import BlockIndex, decoded
from harness.checker.records import cross_examine
from harness.checker.records.contradiction import in_virtual_time
from harness.checker.reference import why_not_handled
from harness.checker.reference.algorithms import HANDLERS, ON_MESSAGE
from harness.checker.steps import _shared_code
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.end_of_record import crashes, failure
from harness.checker.steps.follower import OptionalTraceFields, RecordedTimerExpiry, StepComparer
from harness.checker.steps.trace_header import (
    ROUNDING_S,
    CheckedHeader,
    ImpossibleHeaderError,
    UnknownSettingError,
    checked,
)
from ucp.messages import MalformedDatagramError
from ucp.trace import CommandEntry, DroppedDatagram

SINGLE_WALL_S = 0.03
"""Maximum lateness of a single timer, in seconds of wall time, that needs no explanation."""
MEAN_WALL_S = 0.01
"""Maximum mean lateness of one timer's expiries, in seconds of wall time, that needs no explanation."""
ENOUGH = 8
"""Minimum number of expiries for which a mean is computed."""


@dataclass
class JudgedTimers:
    """The number of judged timer expiries of all agents, and the number of expiries for which the delay of the machine
    was not measured.
    """

    expiries: int = 0
    unmeasured: int = 0

    @property
    def remark(self) -> str:
        """A remark about timers that could not be judged. It is an empty text if all timers were judged."""
        if not self.unmeasured:
            return ""
        which = "timers" if self.unmeasured == self.expiries else f"{self.unmeasured} of {self.expiries} timers"
        return f"; the lag of the machine is not recorded for {which}, so they may be up to 1 s of wall time late"

    def judge(
        self, evidence: Evidence, trace: Trace, expiries: Sequence[RecordedTimerExpiry]
    ) -> Iterator[StepDeviation]:
        """Yield the expiries of an agent's timers that were later than the measured delays of the machine explain."""
        agent_id, speedup = trace.header.agent_id, trace.header.clock.get("speedup")
        if in_virtual_time(trace):
            yield from _in_virtual_time(evidence, agent_id, expiries)
            return
        if not isinstance(speedup, int | float) or speedup <= 0:
            return
        explained: dict[str, list[tuple[RecordedTimerExpiry, float]]] = defaultdict(list)
        for expiry in expiries:
            due_s = expiry.t - max(0.0, expiry.late_s)
            lag_s = evidence.lag.explains(agent_id, due_s, expiry.t) if evidence.lag else None
            self.expiries += 1
            if lag_s is None:
                self.unmeasured += 1
            elif not evidence.was_paused(agent_id, due_s, expiry.t):
                explained[expiry.timer].append((expiry, lag_s * speedup))
        for timer, of_kind in explained.items():
            yield from _of_kind(agent_id, timer, of_kind, speedup)


def _in_virtual_time(
    evidence: Evidence, agent_id: int, expiries: Sequence[RecordedTimerExpiry]
) -> Iterator[StepDeviation]:
    """Yield each expiry that is later than the delays of the scenario explain. Virtual time has no lag."""
    for expiry in expiries:
        due_s = expiry.t - max(0.0, expiry.late_s)
        if expiry.late_s > ROUNDING_S and not evidence.was_delayed(agent_id, due_s, expiry.t):
            what = f"it ran {expiry.late_s:.3g} s after the {expiry.timer} timer expired, and virtual time has no lag"
            yield StepDeviation(agent_id, expiry.line, expiry.t, expiry.handler, what)


def _of_kind(
    agent_id: int, timer: str, expiries: list[tuple[RecordedTimerExpiry, float]], speedup: float
) -> Iterator[StepDeviation]:
    """Yield each expiry of this timer that was too late. If no single expiry was too late, but the mean lateness is too
    high, yield the last expiry.
    """
    late = [(expiry, lag_s) for expiry, lag_s in expiries if expiry.late_s > lag_s + SINGLE_WALL_S * speedup]
    for expiry, lag_s in late:
        what = (
            f"it ran {expiry.late_s:.3g} s after the {timer} timer expired, but the measured lag explains only "
            f"{lag_s:.2g} s"
        )
        yield StepDeviation(agent_id, expiry.line, expiry.t, expiry.handler, what)
    if late or len(expiries) < ENOUGH:
        return
    late_s, lag_s = mean(expiry.late_s for expiry, _ in expiries), mean(lag_s for _, lag_s in expiries)
    if late_s > lag_s + MEAN_WALL_S * speedup:
        last, _ = expiries[-1]
        what = (
            f"{len(expiries)} {timer} timers ran {late_s:.3g} s after they expired on average, but the measured lag "
            f"explains only {lag_s:.2g} s"
        )
        yield StepDeviation(agent_id, last.line, last.t, last.handler, what)


NAME = "every step"


def first_cause(judgement: Judgement | None) -> str | None:
    """Return the subject of the verdict `deviates`: the handler of the first step that deviates, or the edited files of
    the code that judge and agents share. Return None for other verdicts, and if neither is known.
    """
    if judgement is None or judgement.verdict != "deviates":
        return None
    return _shared_code.broken_files() or next((finding.handler for finding in judgement.evidence), None)


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on all steps. The verdict is `deviates` after any difference from the reference, `not
    applicable` if a step could not be judged, and `as specified` otherwise.

    The verdict is also `deviates` if the judge cannot be trusted, because an edit broke code that it shares with the
    agents.
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
    """Return the verdict on all steps, if the shared code is intact."""
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
        return Judgement(NAME, "not applicable", _why(unjudged))
    return Judgement(NAME, "as specified", f"{steps} handler runs, each following Algorithms 1 to 20{timers.remark}")


def _why(unjudged: dict[int, str]) -> str:
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
    """Compare each incarnation of the agent with the reference, up to the first step that contains an undefined
    name.
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
    """Return the judgement for the deviations of all agents. `lost` contains the reasons why some steps could not be
    judged.
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
    """Return the handler of the deviation if it is one of the 20 handlers of the protocol. Return None otherwise."""
    return deviation.handler if deviation.handler in HANDLERS else None


def _title(handler: str | None) -> str:
    """Return the title of a handler, such as "Algorithm 5, vote_timer_expiration"."""
    return f"Algorithm {HANDLERS[handler].algorithm}, {handler}" if handler else "an unknown handler"
