"""Count how the agents handled injected messages. The sources are the injection log and the traces.

The rogue node, a simulated attacker, either forges messages or sends copies of real messages. A forged message has a
sequence number that no agent uses. Each handler run with this number therefore belongs to the rogue node. A copy is
equal to its original, so a trace cannot distinguish copy and original. If an agent handled copy and original, the check
assigns the last handler runs to the copies. Each copy gets at most one handler run, which must be later than the
sending of the copy.

An agent of a secured mission handles each datagram only once, and drops altered datagrams. Corrupted messages therefore
count as not handled. A copy that is sent immediately cannot be distinguished from the original. If an agent handles a
delayed copy, the original did not reach this agent, so the handler run belongs to the copy.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.archive import RunArchive
from harness.archive.run_record import InjectedMessages, RogueInjection
from harness.archive.traces import Trace
from harness.archive.vocabulary import unknown_names
from harness.play.rogue.rogue_line import injection_of
from harness.scenario import Scenario
from harness.scenario.changes import injections_of
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

SKEW_S = 0.05
"""Maximum difference between the clocks of two processes, in mission seconds."""
BRANCHES_NAMED = 6

Count = Annotated[int, Field(ge=0, le=10**9)]


class _RogueLine(BaseModel):
    """A line of `rogue.jsonl`, the log of injected datagrams. The line describes one datagram, or contains only the
    number of several datagrams.
    """

    model_config = ConfigDict(extra="ignore", defer_build=True)

    at_s: float
    injection: int
    what: str
    bytes: Count
    message: str | None = None
    sender: int | None = None
    sequence: int | None = None
    refused: str | dict[str, Count] | None = None
    messages: dict[str, Count] = {}


_Key = tuple[Any, Any, Any]
"""Sender, sequence number and type of a message. Traces identify a message by these three values."""


@dataclass
class _InjectionTally:
    sent: Counter[str] = field(default_factory=Counter)
    bytes: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    untraced: Counter[str] = field(default_factory=Counter)
    handled: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    changed: Counter[str] = field(default_factory=Counter)
    reached: dict[str, set[tuple[_Key, int]]] = field(default_factory=lambda: defaultdict(set))
    """Message type -> the messages that at least one agent handled. Each message has a number that distinguishes its
    injected copies.
    """


def account(scenario: Scenario, archive: RunArchive) -> list[RogueInjection]:
    """Return the effect of each injection that the scenario planned, in the order of the scenario."""
    injections = injections_of(scenario)
    if not injections:
        return []
    tallies = {injection.number: _InjectionTally() for injection in injections}
    has_unknown_names = any(
        {"message", "trigger"} & unknown_names(trace.runs).keys() for trace in archive.traces.values()
    )
    copies: dict[_Key, list[tuple[float, int]]] = defaultdict(list)
    for line in archive.injected(_RogueLine):
        if line.injection in tallies:
            _count_line(line, tallies[line.injection], copies, secured=scenario.security is not None)
    for trace in archive.traces.values():
        for key, runs in _triggered_by(trace, copies).items():
            for number, copy, run in _pair_with_copies(copies.get(key), key, runs):
                if number in tallies:
                    tally, message = tallies[number], str(key[2])
                    tally.handled[message][run.branch] += 1
                    tally.changed[message] += bool(run.changes)
                    tally.reached[message].add((key, copy))
    return [
        _to_record(injection.at_s, injection.what, injection.detail, tallies[injection.number], has_unknown_names)
        for injection in injections
    ]


def in_words(injection: RogueInjection) -> str:
    """Describe the effect of an injection in one line of text."""
    branches = sum((Counter(of.handled) for of in injection.messages), Counter()).most_common()
    done = [f"{branch} {count}" for branch, count in branches[:BRANCHES_NAMED]]
    if len(branches) > BRANCHES_NAMED:
        done.append(f"and {sum(count for _, count in branches[BRANCHES_NAMED:])} more")
    of_them = [f"{sum(injection.refused.values())} of them malformed"] if injection.refused else []
    of_them += [f"{injection.untraced} indistinguishable from their originals"] if injection.untraced else []
    if unhandled := sum(of.unhandled or 0 for of in injection.messages):
        done.append(f"{unhandled} handled by no agent")
    counts = "; ".join([f"{injection.sent} sent", *of_them, *([", ".join(done)] if done else [])])
    return f"{injection.what} at {injection.at_s:g} s, {injection.detail}: {counts}"


def describe_handling(messages: InjectedMessages) -> str:
    """Return the number of handler runs for each result as text, such as "held already 4, committed 1, 2 handled by no
    agent". Return "unknown" if the traces do not show the results.
    """
    done = [f"{branch} {count}" for branch, count in messages.handled.items()]
    return (
        ", ".join([*done, *([f"{messages.unhandled} handled by no agent"] if messages.unhandled else [])]) or "unknown"
    )


def _count_line(
    line: _RogueLine, tally: _InjectionTally, copies: dict[_Key, list[tuple[float, int]]], *, secured: bool
) -> None:
    tally.bytes += line.bytes
    if isinstance(line.refused, str):
        tally.refused[line.refused] += 1
        return
    sent = line.messages if line.message is None else {line.message: 1}
    tally.sent.update(sent)
    tally.refused.update(line.refused or {})
    if line.what in ("forge", "flood") or (secured and line.what == "corrupt"):
        return
    if line.message is None or (secured and line.what == "duplicate"):
        tally.untraced.update(sent)
    else:
        copies[line.sender, line.sequence, line.message].append((line.at_s, line.injection))


def _triggered_by(trace: Trace, copies: Mapping[_Key, Any]) -> dict[_Key, list[HandlerRun]]:
    """Return the handler runs that injected messages may have triggered, by message. If an injected copy equals its
    original, the result also contains the handler runs that the original triggered.
    """
    triggered: dict[_Key, list[HandlerRun]] = defaultdict(list)
    for run in trace.runs:
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger):
            key = (trigger.sender, trigger.sequence, trigger.message)
            if key in copies or injection_of(trigger.sequence) is not None:
                triggered[key].append(run)
    return triggered


def _pair_with_copies(
    copies: Sequence[tuple[float, int]] | None, key: _Key, runs: list[HandlerRun]
) -> Iterator[tuple[int, int, HandlerRun]]:
    """Assign the handler runs for a message to the injected copies of the message. The last run is assigned to the last
    copy, the run before it to the copy before it, and so on. Yield the number of the injection, the index of the copy,
    and the handler run.
    """
    forged = injection_of(key[1])
    if copies is None and forged is not None:
        yield from ((forged, 0, run) for run in runs)
        return
    left = list(runs)
    for copy, (at_s, number) in sorted(enumerate(copies or ()), key=lambda numbered: numbered[1], reverse=True):
        if left and left[-1].t >= at_s - SKEW_S:
            yield number, copy, left.pop()


def _to_record(at_s: float, what: str, detail: str, tally: _InjectionTally, has_unknown_names: bool) -> RogueInjection:
    """Return the record of the effect of one injection. `has_unknown_names` is true if traces contain undefined message
    names.
    """
    messages = [
        InjectedMessages(
            message=message,
            sent=sent,
            handled=dict(tally.handled[message].most_common()),
            changed=tally.changed[message],
            unhandled=None
            if has_unknown_names
            else max(0, sent - len(tally.reached[message]) - tally.untraced[message]),
        )
        for message, sent in tally.sent.most_common()
    ]
    return RogueInjection(
        at_s=at_s,
        what=what,
        detail=detail,
        sent=tally.sent.total() + tally.refused.total(),
        bytes=tally.bytes,
        messages=messages,
        refused=dict(tally.refused.most_common()),
        untraced=tally.untraced.total(),
    )
