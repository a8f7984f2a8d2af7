"""Describe the end of a trace that stops although the agent did not end regularly. An agent that dies in a handler
writes no line for this handler.

If `run.json` exists, it contains the reason. A crash in a handler is a deviation, because no Algorithm ends in an
error. For records from the field, only the records of other agents can show that the mission continued after the last
line. The records do not show whether the agent died in a handler or lost its power. The description therefore names the
next input and both possible causes.
"""

import math
import re
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import NamedTuple

from harness.archive.run_record import AgentRecord
from harness.archive.traces import Trace
from harness.checker.reference.algorithms import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from harness.checker.steps.deviation import StepDeviation
from harness.checker.steps.follower import StepComparer

FAILED = ("crashed", "hung", "broken")
"""Outcomes in run.json of agents that failed before the harness ended them."""
_NAMED = re.compile(r"Algorithm \d+, (\w+)")
_OF_MESSAGE = {message.NAME: handler for message, handler in ON_MESSAGE.items()}


class MessageArrival(NamedTuple):
    """A message to the agent, with its type, sender and sequence number.

    If `arrived` is true, a capture shows that the message reached the agent's vehicle at mission second `t`. Otherwise
    the sender sent the message at mission second `t`, and it may have been lost.
    """

    t: float
    message: str
    sender: int
    sequence: int
    arrived: bool


def crashes(trace: Trace, recorded: AgentRecord | None) -> list[StepDeviation]:
    """Return a deviation for each handler of the agent that ended in an error according to run.json."""
    deviations = []
    for failed in recorded.failures if recorded is not None else ():
        named = _NAMED.search(failed.detail)
        if named is not None and named[1] in HANDLERS:
            line, _ = last_line(trace, failed.incarnation)
            what = f"its record ends here, because the handler did not finish: it {failed.detail}"
            deviations.append(StepDeviation(trace.header.agent_id, line, failed.at_s, named[1], what))
    return deviations


def failure(recorded: AgentRecord | None) -> str | None:
    """Return the reason why a record of an agent ends early. Return None if run.json has no such reason."""
    if recorded is None:
        return None
    if recorded.failures:
        return f"its record ends early: it {recorded.failures[0].detail}"
    return f"its record ends early: it {recorded.detail or recorded.outcome}" if recorded.outcome in FAILED else None


def last_line(trace: Trace, incarnations: int | None = None) -> tuple[int, float]:
    """Return the line number and the mission second of the last handler run. The header is line 1.

    If `incarnations` is given, the function considers only this number of incarnations, from the start of the trace. An
    incarnation is the time between two restarts.
    """
    line, t = 1, 0.0
    for incarnation in islice(trace.incarnations(), incarnations):
        line, t = max(((number, run.t) for number, run in incarnation), default=(line, t))
    return line, t


def unfinished(
    follower: StepComparer, trace: Trace, others_until_s: float, arrivals: Iterator[MessageArrival] | None
) -> str | None:
    """Return a sentence if the trace ends before the mission ended. Return None otherwise.

    Call this function only for an agent that left no export. Other agents certainly continued until mission second
    `others_until_s`. `arrivals` contains the messages to the agent. It is None if it is unknown whether messages
    reached the agent.
    """
    line, t = last_line(trace)
    if others_until_s <= t:
        return None
    ends = f"the record ends at line {line}, t={t:g} s"
    if follower.state.triggered:
        event, by = follower.state.triggered[0]
        name = ON_LOCAL_EVENT[event].name
        return f"{ends}, in {_title(name)}, which {by} triggered; the handler did not finish"
    ended = "the handler did not finish, or the agent had ended"
    running = [timer for timer in follower.state.timers if timer.deadline is not None]
    due = min(((follower.mission_s(timer.deadline or 0.0), timer.name) for timer in running), default=(math.inf, ""))
    came = min((each for each in arrivals or () if each.t > t and each.message in _OF_MESSAGE), default=None)
    if due[0] <= min(others_until_s, came.t if came else math.inf):
        return f"{ends}, before {_title(ON_TIMER[due[1]].name)}, of the {due[1]} timer due at t={due[0]:g} s; {ended}"
    if arrivals is None:
        return None
    if came is None:
        return f"{ends}, although others went on until t={others_until_s:g} s; no record shows its next input"
    named, handler = f"the {came.message} {came.sequence}", _title(_OF_MESSAGE[came.message].name)
    if came.arrived:
        of = f"{named} of agent {came.sender}, which reached the vehicle at t={came.t:g} s"
        return f"{ends}, before {handler}, of {of}; {ended}"
    return (
        f"{ends}, before {handler}, of {named} that agent {came.sender} sent at t={came.t:g} s; it was lost, or {ended}"
    )


def sent_to(agent_id: int, traces: Mapping[int, Trace]) -> Iterator[MessageArrival]:
    """Yield the messages to the agent that other agents sent according to their traces."""
    for sender, trace in traces.items():
        if sender != agent_id:
            for run in trace.runs:
                for sent in run.sent:
                    yield MessageArrival(run.t, sent.message, sender, sent.seq, arrived=False)


def _title(handler: str) -> str:
    return f"Algorithm {HANDLERS[handler].algorithm}, {handler}"
