"""Explore all states that one agent can reach, breadth first.

Two states are the same if no handler can distinguish them. If a chain, stack or deque has more than two blocks, its
length does not affect the branch that a handler takes. Counted answers affect only the handlers that count in the same
activity. A few values therefore describe a state (`state_of`), and the number of states is small enough to visit all of
them. A vector is one input in one of these states.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from harness.checker.reference.algorithms import IS_TOP_OF_CHAIN
from harness.conformance._alphabet import INPUTS, LOG, TIMER, AgentInput
from harness.conformance._reference_model import AGENT, OLD_US, YOUNG_US, ExpectedOutcome, ModelSnapshot, ReferenceModel
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.settings import ALTERNATIVES, Settings

STEP_S = 0.125
"""Mission seconds between two inputs that are not timers, in virtual time."""
MAX_CHAIN, MAX_STACK, MAX_WAITING = 2, 2, 2
MAX_STATES = 4000
"""Maximum number of states. If an error in this module makes the state space infinite, the exploration ends here."""


@dataclass(frozen=True)
class SettingsVariant:
    """A combination of settings for the agent under test."""

    name: str
    settings: Settings
    features: tuple[str, ...] = ()
    """Features of the agent contract that these settings need."""


def _settings(**other: object) -> Settings:
    """Return settings in which each timer has a different duration and each event completes a block. As with the
    default settings, a vote ends before any reconcile phase that begins after the vote.
    """
    timers = {"vote_timeout_s": 10.0, "phase1_timeout_s": 12.0, "phase2_timeout_s": 13.0, "phase3_timeout_s": 14.0}
    room = {"max_block_bytes": MAX_EVENT_DATA_BYTES, "max_event_bytes": MAX_EVENT_DATA_BYTES}
    return Settings(**{**timers, "finalize_gap_s": 4.0, **room, **other})  # type: ignore[arg-type]


VARIANTS: dict[str, SettingsVariant] = {
    variant.name: variant
    for variant in (
        SettingsVariant("default", _settings()),
        SettingsVariant("long votes", _settings(vote_timeout_s=45.0)),
        SettingsVariant("no finalize gap", _settings(finalize_gap_s=0.0)),
        *(
            SettingsVariant(feature, _settings(**{name: value}), (feature,))
            for feature, (name, value) in ALTERNATIVES.items()
        ),
    )
}


class AgentState(NamedTuple):
    """The state of an agent, reduced to the values that handlers can distinguish."""

    activity: str
    """Name of the running timer if the agent reconciles. Otherwise "voting" or "idle". "stuck" means a reconcile
    without a running timer.
    """
    holdings: tuple[str | int, ...]
    """The blocks of the agent: the length of the chain, the owner of its top block, the waiting blocks, and the length
    of the stack. Lengths above a limit count as equal.
    """
    counted: tuple[object, ...]
    """The answers that the agent has counted in its current activity, which is a vote or a phase of a reconcile."""

    @property
    def text(self) -> str:
        chain, top, waiting, stack = self.holdings
        parts = [f"{chain}{'+' if chain == MAX_CHAIN else ''} in the chain{f', {top} on top' if top else ''}"]
        if waiting:
            parts.append(str(waiting))
        if stack:
            parts.append(f"{stack} on the stack")
        if self.counted:
            parts.append(f"counted {self.counted}")
        return f"{self.activity}: {', '.join(parts)}"


def state_of(model: ReferenceModel) -> AgentState:
    state = model.state
    chain = len(state.chain)
    top = "" if not chain else "its own block" if [*state.chain][-1].agent_id == AGENT else "another's block"
    deque_words = ("", "one block waits", "blocks wait")[min(2, len(state.blocks_to_be_committed))]
    voting = state.voting_timer.active
    if state.reconcile_in_progress or any(timer.active for timer in state.reconcile_timers):
        waiting = "a vote runs" if voting else "blocks wait" if deque_words else ""
    else:
        waiting = deque_words
    holdings = (min(chain, MAX_CHAIN), top, waiting, min(len(state.reconcile_stack), MAX_STACK))
    running = next((timer.name for timer in state.reconcile_timers if timer.active), None)
    if running == "phase one":
        counted: tuple[object, ...] = tuple(state.reconcile_vote_count.values())
    elif running == "phase two":
        counted = _candidates(model)
    elif running is None and voting and not state.reconcile_in_progress:
        changed = state.top_chain_hash_at_initiation != state.chain.top_chain_hash
        counted = (*state.vote_count.values(), "the chain has changed" if changed else "")
    else:
        counted = ()
    return AgentState(
        running or ("stuck" if state.reconcile_in_progress else "voting" if voting else "idle"), holdings, counted
    )


def _candidates(model: ReferenceModel) -> tuple[object, ...]:
    """Return three values for each candidate of reconcile phase 2: the kind of its block, the age of its block, and the
    number of answers that named it.
    """
    state = model.state
    stack = [block.block_hash for block in reversed(state.reconcile_stack)]
    candidates = []
    for candidate, (count, timestamp_us) in state.reconcile_response_dictionary.items():
        if candidate == IS_TOP_OF_CHAIN:
            what = "top"
        elif candidate in stack:
            what = f"stack {min(stack.index(candidate), 1) + 1}"
        else:
            what = "held" if state.holds(candidate) else "new"
        age = "old" if timestamp_us < 2 * OLD_US else "young" if timestamp_us >= YOUNG_US else "own"
        candidates.append((what, age, count))
    return tuple(sorted(candidates))


class VectorKey(NamedTuple):
    """The identity of a generated test. A test is one input in one state. `counted` is empty if the effect of the input
    does not depend on the counted answers.
    """

    activity: str
    holdings: tuple[str | int, ...]
    counted: tuple[object, ...]
    input: str


def key_of(state: AgentState, given: AgentInput) -> VectorKey:
    matters: bool = given.tally == "timer" or given.tally == state.activity
    return VectorKey(state.activity, state.holdings, state.counted if matters else (), given.name)


@dataclass(frozen=True)
class AgentTransition:
    """A transition between two states: the input in `key` leads from `before` to `after`."""

    key: VectorKey
    path: tuple[str, ...]
    """Inputs that lead from the start to `before`, by the shortest path."""
    before: AgentState
    after: AgentState
    outcome: ExpectedOutcome
    expired: str | None
    """Name of the timer that expired in this transition. None if the input is no expiry."""


def next_timer_name(model: ReferenceModel) -> str | None:
    """Return the name of the timer that expires next. Return None if no timer runs."""
    running = [timer for timer in model.state.timers if timer.deadline is not None]
    return min(running, key=lambda timer: timer.deadline or 0.0).name if running else None


def advance(model: ReferenceModel, given: AgentInput, now: float) -> tuple[ExpectedOutcome, float] | None:
    """Give the reference an input in virtual time, and return its handler runs and the time.

    Return None if the input is impossible in the current state.
    """
    if given.preceding is not None:
        before = advance(model, INPUTS[given.preceding], now)
        return None if before is None else advance(model, INPUTS[TIMER], before[1])
    action = given.make(model)
    if action is None:
        return None
    deadline = model.agent.next_timer()
    now = deadline if given.tally == "timer" and deadline is not None else now + STEP_S
    return model.feed(action, now, timestamp_us=round(now * 1_000_000)), now


def explore(variant: SettingsVariant) -> Iterator[AgentTransition]:
    """Yield each generated test once, with a shortest sequence of inputs that leads to it. Each call yields the same
    tests.
    """
    seen: set[VectorKey] = set()
    model = ReferenceModel(variant.settings)
    start = state_of(model)
    reached = {start}
    waiting: deque[tuple[AgentState, tuple[str, ...], ModelSnapshot, float]] = deque(
        [(start, (), ModelSnapshot(model), 0.0)]
    )
    while waiting and len(reached) < MAX_STATES:
        before, path, snapshot, now = waiting.popleft()
        model = snapshot.restore()
        for given in INPUTS.values():
            key = key_of(before, given)
            if (
                key in seen
                or _is_redundant(model, before, given)
                or (given.preceding and not _reveals_counting(snapshot, now, before, given))
            ):
                continue
            expired = next_timer_name(model) if given.tally == "timer" else None
            advanced = advance(model, given, now)
            if advanced is None:
                continue
            outcome, then = advanced
            seen.add(key)
            after = state_of(model)
            yield AgentTransition(key, path, before, after, outcome, expired)
            if after not in reached:
                reached.add(after)
                waiting.append((after, (*path, given.name), ModelSnapshot(model), then))
            if not changes_nothing(outcome):
                snapshot.restore()


def walk(variant: SettingsVariant, path: tuple[str, ...]) -> tuple[ReferenceModel, float]:
    """Return the reference agent after these inputs, and the time of the last input."""
    model, now = ReferenceModel(variant.settings), 0.0
    for name in path:
        advanced = advance(model, INPUTS[name], now)
        assert advanced is not None, f"{name} was possible when the path was found"
        now = advanced[1]
    return model, now


_CHANGING_BRANCHES = {
    "receive_request_add_block": None,
    "receive_request_chain_contain": None,
    "receive_request_block_for_hash": None,
    "receive_commit_block": ("committed",),
    "receive_request_next_in_sequence": ("diverged",),
    "receive_vote_add_block": ("yes", "no"),
    "receive_phase_1_response": ("yes", "no"),
    "receive_response_next_in_sequence": ("new candidate", "counted"),
    "receive_response_block_for_hash": ("committed",),
}
"""Handler -> the branches that change the agent. None if no branch of the handler changes the agent."""


def changes_nothing(outcome: ExpectedOutcome) -> bool:
    """Return true if these handler runs do not change the agent."""
    if len(outcome.runs) != 1:
        return False
    (run,) = outcome.runs
    return run.handler in _CHANGING_BRANCHES and run.branch not in (_CHANGING_BRANCHES[run.handler] or ())


COUNTING_HANDLERS = {"receive_vote_add_block", "receive_phase_1_response", "receive_response_next_in_sequence"}
"""Handlers that only count an answer. A wrong count becomes visible only when the timer expires."""
COUNTING_STATES = {
    ("voting", (2, "another's block", "one block waits", 0)),
    ("voting", (2, "another's block", "blocks wait", 0)),
    ("phase one", (2, "another's block", "", 0)),
    ("phase two", (2, "another's block", "", 0)),
}
"""Pairs of activity and holdings. In states with such a pair, the exploration tries more than one answer, and tests
answers that the agent must ignore. It tests this only here, because an agent counts and decides in the same way in all
other states. These states have a long chain and an empty stack, so that one agent can reach them repeatedly.
"""


def _reveals_counting(snapshot: ModelSnapshot, now: float, before: AgentState, given: AgentInput) -> bool:
    """Return true if the next expiry of the timer would show whether the agent has wrongly counted this answer."""
    if (
        (before.activity, before.holdings) not in COUNTING_STATES
        or given.preceding is None
        or given.counted_twin is None
    ):
        return False
    ignored = _outcome_of_timer(snapshot, now, given.preceding, counts=False)
    counted = _outcome_of_timer(snapshot, now, given.counted_twin, counts=True)
    snapshot.restore()
    return (
        ignored is not None and counted is not None and handlers_and_messages(ignored) != handlers_and_messages(counted)
    )


def _outcome_of_timer(snapshot: ModelSnapshot, now: float, name: str, *, counts: bool) -> ExpectedOutcome | None:
    """Return the handler runs of the timer expiry that follows this input. `counts` is true for an input that the agent
    must count, and false for an input that it must ignore.

    Return None if the input is impossible in the saved state, or if `counts` is wrong for this input.
    """
    model = snapshot.restore()
    advanced = advance(model, INPUTS[name], now)
    if (
        advanced is None
        or advanced[0].runs[0].handler not in COUNTING_HANDLERS
        or changes_nothing(advanced[0]) is counts
    ):
        return None
    ended = advance(model, INPUTS[TIMER], advanced[1])
    return None if ended is None else ended[0]


def handlers_and_messages(outcome: ExpectedOutcome) -> tuple[object, ...]:
    """Return the names of the handlers, branches and messages of these handler runs. The names do not depend on block
    hashes.
    """
    return tuple((run.handler, run.branch, tuple(message.NAME for message in run.sent)) for run in outcome.runs)


def _is_redundant(model: ReferenceModel, before: AgentState, given: AgentInput) -> bool:
    """Return true if a test of this input adds nothing: it leads only to states that are equivalent to known ones, or
    its effect depends on more than the state.
    """
    if given.name == LOG:
        return len(model.state.blocks_to_be_committed) >= MAX_WAITING
    if before.activity != "voting" and "waits behind" in given.name:
        return True
    if given.tally != before.activity or "of an agent that has" in given.name:
        return False
    return _answer_count(model, before) >= 1 and (before.activity, before.holdings) not in COUNTING_STATES


def _answer_count(model: ReferenceModel, before: AgentState) -> int:
    """Return the number of answers that the agent has counted for its current vote or query."""
    state = model.state
    match before.activity:
        case "voting":
            return len(state.voters)
        case "phase one":
            return sum(state.reconcile_vote_count.values())
    return sum(count for count, _ in state.reconcile_response_dictionary.values())
