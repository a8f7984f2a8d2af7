"""List the known names in traces: names of handlers, timers, branches, messages and operations.

An agent may use names that CONTRACT.md does not define and still behave correctly. The verdict of a check that depends
on an unknown name is "not applicable" or "unknown", never a violation.
"""

from collections.abc import Collection, Iterable
from typing import Literal

from ucp.messages import TYPE_CODES
from ucp.trace import HandlerRun
from ucp.trigger import KINDS, LocalTrigger, MessageTrigger, TimerTrigger, UnknownTrigger

Kind = Literal["trigger", "handler", "timer", "branch", "message", "operation", "tally"]

UnknownNames = dict[Kind, str]
"""Kind -> a description of the first unknown name of that kind, such as "unknown timer name 'x'"."""

CRASHED = "crashed by quirk"
"""The branch that is recorded if a handler of a wrong agent raised an exception."""

BRANCHES = {
    name: frozenset((*branches, CRASHED))
    for name, branches in {
        "build_data_block": ("building", "full"),
        "process_next_deque_block": ("reconcile in progress", "vote running", "deque empty", "proposed"),
        "receive_request_add_block": ("reconcile in progress", "approve", "disapprove"),
        "receive_vote_add_block": (
            "no vote running",
            "another block",
            "another round",
            "counted already",
            "yes",
            "no",
        ),
        "vote_timer_expiration": ("reconcile in progress", "chain changed", "approved", "not approved"),
        "receive_commit_block": (
            "reconcile in progress",
            "does not succeed",
            "held already",
            "committed",
            "ignored by quirk",
        ),
        "reconcile_begin": ("already in progress", "begun"),
        "reconcile_phase_1": ("asked",),
        "receive_request_chain_contain": ("reconcile in progress", "yes", "no"),
        "receive_phase_1_response": ("not in phase 1", "another chain", "counted already", "yes", "no"),
        "reconcile_phase_1_timer_expiration": ("no response", "not contained", "at inception", "contained"),
        "reconcile_phase_2": ("asked",),
        "receive_request_next_in_sequence": ("reconcile in progress", "top of chain", "successor", "diverged"),
        "receive_response_next_in_sequence": (
            "not in phase 2",
            "another chain",
            "counted already",
            "new candidate",
            "counted",
        ),
        "reconcile_phase_2_timer_expiration": (
            "no response",
            "top of chain",
            "block",
            "tie: top of chain",
            "tie: block",
        ),
        "reconcile_phase_3": ("from the stack", "held already", "asked"),
        "receive_request_block_for_hash": ("reconcile in progress", "sent", "not held"),
        "receive_response_block_for_hash": ("not in phase 3", "another block", "committed"),
        "reconcile_phase_3_timer_expiration": ("gave up",),
        "reconcile_finalize": ("asked who follows", "recommitted, more to come", "done"),
    }.items()
}
"""Handler -> the branches that the handler can take. Some branches occur only in agents with an error. The table
repeats names of the agent core, because the checker must not depend on the agent core that it judges.
"""

TIMER_OF = {
    "vote_timer_expiration": "voting",
    "reconcile_phase_1_timer_expiration": "phase one",
    "reconcile_phase_2_timer_expiration": "phase two",
    "reconcile_phase_3_timer_expiration": "phase three",
    "reconcile_finalize": "finalize gap",
}
"""Handler -> the timer whose expiry triggers it."""
TIMERS = frozenset(TIMER_OF.values())
MESSAGES = frozenset(message.NAME for message in TYPE_CODES)
OPERATIONS = frozenset(("complete", "chain+", "chain-", "deque+", "deque-", "stack+", "stack-"))
VOTES = frozenset(("yes", "no"))
COUNTS_VOTES = frozenset(
    ("process_next_deque_block", "receive_vote_add_block", "reconcile_phase_1", "receive_phase_1_response")
)
"""Handlers whose tally has the keys of `VOTES`. The keys of other tallies are block hashes."""

IGNORED_KINDS: frozenset[Kind] = frozenset(("branch", "tally", "timer"))
"""Kinds of unknown names that do not prevent the comparison of a step. A step with an unknown name of another kind
cannot be compared. Timer names belong to this list, because the handler determines the timer.
"""

MAX_SHOWN = 40
"""Maximum number of characters of an unknown name that a message shows."""


def unknown_names(runs: Iterable[HandlerRun]) -> UnknownNames:
    """Return the first undefined name of each kind. The name of a branch is also undefined if it belongs only to other
    handlers.
    """
    unknown: UnknownNames = {}
    for handler, branch in dict.fromkeys((run.handler, run.branch) for run in runs):
        if handler not in BRANCHES:
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
                kind: Kind = "timer" if run.handler in TIMER_OF else "trigger"
                unknown.setdefault(kind, f"unknown timer name {_shown(trigger.timer)}")
        elif isinstance(trigger, LocalTrigger):
            if trigger.handler not in BRANCHES:
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
        if run.tally and not (run.tally.keys() <= VOTES or tally_is_known(run)):
            name = next((key for key in run.tally if key not in VOTES), "")
            unknown.setdefault("tally", f"unknown key {_shown(name)} of the tally of {run.handler}")
    return unknown


def tally_is_known(run: HandlerRun) -> bool:
    """Return true if all keys of the vote count are defined for the handler."""
    return not run.tally or run.handler not in COUNTS_VOTES or VOTES.issuperset(run.tally)


def has_unknown_kind(trigger: UnknownTrigger) -> bool:
    """Return true if the trigger has a kind that the agent contract does not define. Return false for a malformed
    trigger.
    """
    return bool(trigger.fields) and KINDS.isdisjoint(trigger.fields)


def timer_that_ended(run: HandlerRun, trigger: TimerTrigger) -> str:
    """Return the name of the timer that triggered the handler run. If the name in the trace is unknown, return the name
    of the timer whose expiry triggers this handler. If no timer triggers this handler, return the unknown name.
    """
    name = trigger.timer
    return name if name in TIMERS else TIMER_OF.get(run.handler, name)


def timers_are_known(run: HandlerRun) -> bool:
    """Return true if all timers that the handler run started have defined names."""
    return not run.started or TIMERS.issuperset(run.started)


def branch_is_known(run: HandlerRun) -> bool:
    """Return true if the handler of this run has a branch with the recorded name."""
    return run.branch in BRANCHES.get(run.handler, ())


def first_unknown(unknown: UnknownNames, kinds: Collection[Kind] | None = None) -> str | None:
    """Return the description of the first undefined name of these kinds, or of any kind if `kinds` is None. Return None
    if all names are defined.
    """
    return next((description for kind, description in unknown.items() if kinds is None or kind in kinds), None)


def _shown(name: object) -> str:
    return repr(str(name)[:MAX_SHOWN])
