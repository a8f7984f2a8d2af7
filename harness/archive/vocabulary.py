"""Words of a trace that the harness does not know: names of handlers, timers, branches, messages and the like.

An agent that names what it does otherwise than CONTRACT.md is not wrong in what it does. What depends on such a word
cannot be told: it is "not applicable", or "not known", and no accusation.
"""

from collections.abc import Collection, Iterable
from typing import Literal

from ucp.agent import HANDLERS, ON_MESSAGE, ON_TIMER
from ucp.quirks import CRASHED, QUIRKS
from ucp.trace import HandlerRun
from ucp.trigger import KINDS, LocalTrigger, MessageTrigger, TimerTrigger, UnknownTrigger

Kind = Literal["trigger", "handler", "timer", "branch", "message", "operation", "tally"]

UnknownNames = dict[Kind, str]
"""Kind -> the first unknown word of that kind, in words: "unknown timer name 'x'"."""

TIMERS = frozenset(ON_TIMER)
MESSAGES = frozenset(message.NAME for message in ON_MESSAGE)
OPERATIONS = frozenset(("complete", "chain+", "chain-", "deque+", "deque-", "stack+", "stack-"))
VOTES = frozenset(("yes", "no"))
BRANCHES = {
    name: frozenset(
        (
            *handler.branches,
            *(
                branch
                for quirk in QUIRKS.values()
                if handler.algorithm in quirk.algorithms
                for branch in quirk.branches
            ),
            CRASHED,
        )
    )
    for name, handler in HANDLERS.items()
}
"""Handler -> the branches that it can take, those of wrong agents among them."""
TALLIES = {
    name: VOTES if handler.tally in ("vote_count", "reconcile_vote_count") else None
    for name, handler in HANDLERS.items()
}
"""Handler -> the keys of its tally; None if they are block hashes."""

IGNORED_KINDS: frozenset[Kind] = frozenset(("branch", "tally", "timer"))
"""Of a step with unknown words of these kinds all the rest can be judged; with others it is not known what it was.

Which timer ended, its handler tells.
"""

_TIMER_OF = {handler.name: timer for timer, handler in ON_TIMER.items()}

MAX_SHOWN = 40
"""More of an unknown word is not shown."""


def unknown_names(runs: Iterable[HandlerRun]) -> UnknownNames:
    """The first unknown word of each kind; a branch is one of the handler that takes it."""
    unknown: UnknownNames = {}
    for handler, branch in dict.fromkeys((run.handler, run.branch) for run in runs):
        if handler not in HANDLERS:
            unknown.setdefault("handler", f"unknown handler name {_shown(handler)}")
        elif branch not in BRANCHES[handler]:
            unknown.setdefault("branch", f"unknown branch {_shown(branch)} of {handler}")
    for run in runs:
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger):
            if trigger.message not in MESSAGES:
                unknown.setdefault("message", f"unknown message name {_shown(trigger.message)}")
        elif isinstance(trigger, TimerTrigger):
            if trigger.timer not in TIMERS:
                kind: Kind = "timer" if run.handler in _TIMER_OF else "trigger"
                unknown.setdefault(kind, f"unknown timer name {_shown(trigger.timer)}")
        elif isinstance(trigger, LocalTrigger):
            if trigger.handler not in HANDLERS:
                unknown.setdefault("handler", f"unknown handler name {_shown(trigger.handler)}")
        elif isinstance(trigger, UnknownTrigger) and has_unknown_kind(trigger):
            unknown.setdefault("trigger", f"unknown trigger {_shown(next(iter(trigger.fields)))}")
        for operation, _ in run.changes:
            if operation not in OPERATIONS:
                unknown.setdefault("operation", f"unknown operation {_shown(operation)}")
        for sent in run.sent:
            if sent.message not in MESSAGES:
                unknown.setdefault("message", f"unknown message name {_shown(sent.message)}")
        for timer in run.started or ():
            if timer not in TIMERS:
                unknown.setdefault("timer", f"unknown timer name {_shown(timer)}")
        if run.tally and not tally_is_known(run):
            name = next((key for key in run.tally if key not in VOTES), "")
            unknown.setdefault("tally", f"unknown key {_shown(name)} of the tally of {run.handler}")
    return unknown


def tally_is_known(run: HandlerRun) -> bool:
    """Whether all keys of its tally are of that handler's."""
    keys = TALLIES.get(run.handler)
    return not run.tally or keys is None or keys.issuperset(run.tally)


def has_unknown_kind(trigger: UnknownTrigger) -> bool:
    """Whether the trigger names a kind that the contract does not have, rather than none or a malformed one."""
    return bool(trigger.fields) and KINDS.isdisjoint(trigger.fields)


def timer_that_ended(run: HandlerRun, trigger: TimerTrigger) -> str:
    """The timer that triggered the run. For an unknown name, the timer whose handler ran, if there is one."""
    name = trigger.timer
    return name if name in TIMERS else _TIMER_OF.get(run.handler, name)


def timers_are_known(run: HandlerRun) -> bool:
    """Whether all timers that it started are named as they are known."""
    return not run.started or TIMERS.issuperset(run.started)


def branch_is_known(run: HandlerRun) -> bool:
    """Whether its handler can take this branch."""
    return run.branch in BRANCHES.get(run.handler, ())


def first_unknown(unknown: UnknownNames, kinds: Collection[Kind] | None = None) -> str | None:
    """The first unknown word, of these kinds if they are given; None if there is none."""
    return next((description for kind, description in unknown.items() if kinds is None or kind in kinds), None)


def _shown(name: object) -> str:
    return repr(str(name)[:MAX_SHOWN])
