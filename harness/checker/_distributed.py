"""Check characteristic 1: agents work without a coordinator, and an agent runs code only in reaction to an event.

Every handler run has a local trigger, or a message that its sender really sent. Every vote ends with its own timer, so
no vote waits for another agent. The check needs traces, and it must know the names of the handlers and messages in
these traces.
"""

from typing import Any

from harness.archive.vocabulary import MESSAGES, TIMERS, has_unknown_kind
from harness.checker._waiting import waited_too_long
from harness.checker.evidence import Evidence, Sendings
from harness.checker.judgement import Finding, Judgement, agents, violated
from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from ucp.trace import HandlerRun
from ucp.trigger import (
    BootTrigger,
    EventTrigger,
    LocalTrigger,
    MessageTrigger,
    OperatorTrigger,
    TimerTrigger,
    UnknownTrigger,
)

NAME = "distributed"

_OF_MESSAGE = {message.NAME: handler.name for message, handler in ON_MESSAGE.items()}
_OF_TIMER = {timer: handler.name for timer, handler in ON_TIMER.items()}
_OF_EVENT = ON_LOCAL_EVENT["Build Data Block"].name
_LOCAL = {handler.name for handler in ON_LOCAL_EVENT.values()}


def check(evidence: Evidence) -> Judgement:
    """Check the trigger of every handler run in all traces, and return the verdict on characteristic 1. The verdict is
    `not applicable` if a trace is missing, damaged or incomplete.
    """
    if not evidence.traces:
        return Judgement(
            NAME, "not applicable", "the run has no traces, and exports do not show the triggers of handlers"
        )
    sent = evidence.sendings
    findings: list[Finding] = []
    untraced: set[int] = set()
    sends_unknown = {agent_id for agent_id, words in evidence.unknown.items() if "message" in words}
    runs = 0
    for agent_id, trace in evidence.traces.items():
        runs += len(trace.runs)
        for life in trace.incarnations():
            ran: set[str] = set()
            for line, run in life:
                ran.add(run.handler)
                if _is_certainly_correct(run, ran, sent):
                    continue  # a fast path for most runs
                sender = run.trigger.sender if isinstance(run.trigger, MessageTrigger) else None
                if sender is not None and sender not in sent:
                    untraced.add(sender)
                    continue
                if not _has_known_names(run) or sender in sends_unknown:
                    continue
                wrong = _wrong_trigger(run, ran, sent)
                if wrong and sender in evidence.injected.outside_senders:
                    untraced.add(sender)
                    continue
                if wrong and not (sender is not None and evidence.traces[sender].problem):
                    findings.append(Finding(agent_id, f"trace line {line}, t={run.t:g} s: {run.handler} {wrong}"))
    findings += waited_too_long(evidence)
    if findings:
        return violated(NAME, "a handler ran without a valid trigger, or waited for another agent", findings)
    if unknown := evidence.describe_unknown_name("trigger", "handler", "timer", "message", "branch"):
        return Judgement(NAME, "not applicable", unknown)
    silent = sorted(set(evidence.roster or evidence.exports) - set(evidence.traces))
    if untraced or silent:
        return Judgement(
            NAME,
            "not applicable",
            f"the trace of {agents(untraced | set(silent))} is missing, so their messages and steps cannot be checked",
        )
    damaged = [agent_id for agent_id, trace in evidence.traces.items() if trace.problem]
    if damaged:
        why = f"the trace of {agents(damaged)} is incomplete: {evidence.traces[damaged[0]].problem}"
        return Judgement(NAME, "not applicable", why)
    return Judgement(NAME, "holds", f"{runs} handler runs, each triggered locally or by a message that its sender sent")


def _is_certainly_correct(run: HandlerRun, ran: set[str], sent: dict[Any, Sendings]) -> bool:
    """Return true if the trigger of a handler run is certainly valid: the agent's own timer, an event, an earlier
    handler, or a message that its sender really sent.
    """
    trigger, handler = run.trigger, run.handler
    if isinstance(trigger, MessageTrigger):
        name = trigger.message
        return _OF_MESSAGE.get(name) == handler and trigger.sequence in sent.get(trigger.sender, {}).get(name, ())
    if isinstance(trigger, LocalTrigger):
        return handler in _LOCAL and trigger.handler in ran
    if isinstance(trigger, EventTrigger):
        return handler == _OF_EVENT
    return isinstance(trigger, TimerTrigger) and _OF_TIMER.get(trigger.timer) == handler


def _has_known_names(run: HandlerRun) -> bool:
    """Return true if the agent contract defines both the name of the handler and the name of its trigger."""
    if run.handler not in HANDLERS:
        return False
    match run.trigger:
        case MessageTrigger(message):
            return message in MESSAGES
        case TimerTrigger(timer):
            return timer in TIMERS
        case LocalTrigger(handler):
            return handler in HANDLERS
        case UnknownTrigger() as unknown:
            return not has_unknown_kind(unknown)
    return True


def _wrong_trigger(run: HandlerRun, ran: set[str], sent: dict[int, Sendings]) -> str | None:
    """Return a phrase about the error in the trigger of a handler run. The phrase completes a sentence that begins with
    "the handler". Return None if the trigger is valid.
    """
    match run.trigger:
        case MessageTrigger(name, sender, sequence):
            if _OF_MESSAGE.get(name) != run.handler:
                return f"was triggered by a {name}, which triggers another handler"
            if sequence not in sent[sender].get(name, ()):
                return f"was triggered by {name} number {sequence}, which agent {sender} never sent"
        case TimerTrigger(timer):
            if _OF_TIMER.get(timer) != run.handler:
                return f"was triggered by the {timer} timer, which triggers another handler"
        case LocalTrigger(by):
            if run.handler not in _LOCAL or by not in ran:
                return f"was triggered by {by}, which did not run before"
        case EventTrigger():
            if run.handler != _OF_EVENT:
                return "was triggered by a logged event, which triggers only Build Data Block"
        case OperatorTrigger():
            if run.handler != "reconcile_begin":
                return "was triggered by the operator, which only begins a reconcile"
        case BootTrigger():
            if run.handler != "reconcile_finalize" or len(ran) > 1:
                return "was triggered by a boot, which only ends a reconcile and is the first step"
        case _:
            return "has no trigger"
    return None
