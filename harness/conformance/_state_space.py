"""States, as far as they differ to an agent; and the walk over all of them, breadth first.

What lies deep in the chain, or how many blocks wait behind the second, makes no difference to any handler, and what has
been counted matters only to what counts on. So a state is told by a few numbers (`state_of`), and a vector stands for
one input in one of them.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from harness.checker.reference.algorithms import IS_TOP_OF_CHAIN
from harness.conformance._alphabet import INPUTS, LOG, TIMER, Input
from harness.conformance._reference_model import AGENT, OLD_US, YOUNG_US, Model, Moment, Outcome
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.settings import ALTERNATIVES, Settings

STEP_S = 0.125
"""Mission seconds between two inputs that are not timers, in virtual time."""
MOST_CHAIN, MOST_STACK, MOST_WAITING = 2, 2, 2
MOST_STATES = 4000
"""So that a mistake in here ends."""


@dataclass(frozen=True)
class Variant:
    """Settings that make another agent; `features` are what they need of it."""

    name: str
    settings: Settings
    features: tuple[str, ...] = ()


def _settings(**other: object) -> Settings:
    """Timers of different lengths; a vote that runs ends before any phase that begins after it. Each event fills a
    block."""
    timers = {"vote_timeout_s": 10.0, "phase1_timeout_s": 12.0, "phase2_timeout_s": 13.0, "phase3_timeout_s": 14.0}
    room = {"max_block_bytes": MAX_EVENT_DATA_BYTES, "max_event_bytes": MAX_EVENT_DATA_BYTES}
    return Settings(**{**timers, "finalize_gap_s": 4.0, **room, **other})  # type: ignore[arg-type]


VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant("default", _settings()),
        Variant("long votes", _settings(vote_timeout_s=45.0)),
        Variant("no finalize gap", _settings(finalize_gap_s=0.0)),
        *(Variant(feature, _settings(**{name: value}), (feature,)) for feature, (name, value) in ALTERNATIVES.items()),
    )
}


class State(NamedTuple):
    """What makes a difference. `holds` is what the agent has and does, `counted` what it has been told."""

    doing: str
    """Its timer of a reconcile, "voting", "idle", or "stuck"."""
    holds: tuple[str | int, ...]
    counted: tuple[object, ...]

    @property
    def text(self) -> str:
        chain, top, waiting, stack = self.holds
        parts = [f"{chain}{'+' if chain == MOST_CHAIN else ''} in the chain{f', {top} on top' if top else ''}"]
        if waiting:
            parts.append(str(waiting))
        if stack:
            parts.append(f"{stack} on the stack")
        if self.counted:
            parts.append(f"counted {self.counted}")
        return f"{self.doing}: {', '.join(parts)}"


def state_of(model: Model) -> State:
    state = model.state
    chain = len(state.chain)
    top = "" if not chain else "its own block" if [*state.chain][-1].agent_id == AGENT else "another's block"
    deque_words = ("", "one block waits", "blocks wait")[min(2, len(state.blocks_to_be_committed))]
    voting = state.voting_timer.active
    if state.reconcile_in_progress or any(timer.active for timer in state.reconcile_timers):
        waiting = "a vote runs" if voting else "blocks wait" if deque_words else ""
    else:
        waiting = deque_words
    holds = (min(chain, MOST_CHAIN), top, waiting, min(len(state.reconcile_stack), MOST_STACK))
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
    return State(
        running or ("stuck" if state.reconcile_in_progress else "voting" if voting else "idle"), holds, counted
    )


def _candidates(model: Model) -> tuple[object, ...]:
    """What has been named in phase 2: what it is, how old, and how often."""
    state = model.state
    stack = [block.block_hash for block in reversed(state.reconcile_stack)]
    told = []
    for candidate, (count, timestamp_us) in state.reconcile_response_dictionary.items():
        if candidate == IS_TOP_OF_CHAIN:
            what = "top"
        elif candidate in stack:
            what = f"stack {min(stack.index(candidate), 1) + 1}"
        else:
            what = "held" if state.holds(candidate) else "new"
        age = "old" if timestamp_us < 2 * OLD_US else "young" if timestamp_us >= YOUNG_US else "own"
        told.append((what, age, count))
    return tuple(sorted(told))


class Pair(NamedTuple):
    """What a vector stands for: an input in a state, of which `counted` is there only if it matters to the input."""

    doing: str
    holds: tuple[str | int, ...]
    counted: tuple[object, ...]
    input: str


def pair_of(state: State, given: Input) -> Pair:
    matters: bool = given.tally == "timer" or given.tally == state.doing
    return Pair(state.doing, state.holds, state.counted if matters else (), given.name)


@dataclass(frozen=True)
class Step:
    """An edge of the walk: `given` in `before` leads to `after`. `way` are the inputs that lead to `before`."""

    pair: Pair
    way: tuple[str, ...]
    before: State
    after: State
    outcome: Outcome
    expired: str | None
    """The timer that ended."""


def ends_next(model: Model) -> str | None:
    """The timer that ends next."""
    running = [timer for timer in model.state.timers if timer.deadline is not None]
    return min(running, key=lambda timer: timer.deadline or 0.0).name if running else None


def advance(model: Model, given: Input, now: float) -> tuple[Outcome, float] | None:
    """Give the reference the input in virtual time: what comes of it, and when; None if there is no such input."""
    if given.first is not None:
        before = advance(model, INPUTS[given.first], now)
        return None if before is None else advance(model, INPUTS[TIMER], before[1])
    action = given.make(model)
    if action is None:
        return None
    deadline = model.agent.next_timer()
    now = deadline if given.tally == "timer" and deadline is not None else now + STEP_S
    return model.feed(action, now, timestamp_us=round(now * 1_000_000)), now


def explore(variant: Variant) -> Iterator[Step]:
    """Each pair of a state and an input, once, by the shortest way to it; the same at each call."""
    seen: set[Pair] = set()
    model = Model(variant.settings)
    start = state_of(model)
    reached = {start}
    waiting: deque[tuple[State, tuple[str, ...], Moment, float]] = deque([(start, (), Moment(model), 0.0)])
    while waiting and len(reached) < MOST_STATES:
        before, way, moment, now = waiting.popleft()
        model = moment.put_back()
        for given in INPUTS.values():
            pair = pair_of(before, given)
            if (
                pair in seen
                or _too_much(model, before, given)
                or (given.first and not _tells(moment, now, before, given))
            ):
                continue
            expired = ends_next(model) if given.tally == "timer" else None
            advanced = advance(model, given, now)
            if advanced is None:
                continue
            outcome, then = advanced
            seen.add(pair)
            after = state_of(model)
            yield Step(pair, way, before, after, outcome, expired)
            if after not in reached:
                reached.add(after)
                waiting.append((after, (*way, given.name), Moment(model), then))
            if not is_unchanged(outcome):
                moment.put_back()


def walk(variant: Variant, way: tuple[str, ...]) -> tuple[Model, float]:
    """The reference after these inputs, and when."""
    model, now = Model(variant.settings), 0.0
    for name in way:
        advanced = advance(model, INPUTS[name], now)
        assert advanced is not None, f"{name} was there when the path was found"
        now = advanced[1]
    return model, now


_CHANGE_NOTHING = {
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
"""Handler -> the branches that change the agent; None if none does."""


def is_unchanged(outcome: Outcome) -> bool:
    """Whether the agent is as it was."""
    if len(outcome.runs) != 1:
        return False
    (run,) = outcome.runs
    return run.handler in _CHANGE_NOTHING and run.branch not in (_CHANGE_NOTHING[run.handler] or ())


COUNTING = {"receive_vote_add_block", "receive_phase_1_response", "receive_response_next_in_sequence"}
"""Handlers of which what they should not have done is seen only when a timer ends."""
COUNTED_IN = {
    ("voting", (2, "another's block", "one block waits", 0)),
    ("voting", (2, "another's block", "blocks wait", 0)),
    ("phase one", (2, "another's block", "", 0)),
    ("phase two", (2, "another's block", "", 0)),
}
"""What the agent does and holds in those states in which more than one answer is explored, and in which it is looked at
whether it counted what it should not: how it counts and chooses depends on nothing else. The chain is a long one, and
nothing is on the stack, so that one agent can come there as often as it is led there."""


def _tells(moment: Moment, now: float, before: State, given: Input) -> bool:
    """Whether an agent that counts the input would do otherwise at the end of the timer."""
    if (before.doing, before.holds) not in COUNTED_IN or given.first is None or given.as_if is None:
        return False
    rightly = _then_timer(moment, now, given.first, counts=False)
    wrongly = _then_timer(moment, now, given.as_if, counts=True)
    moment.put_back()
    return rightly is not None and wrongly is not None and in_short(rightly) != in_short(wrongly)


def _then_timer(moment: Moment, now: float, name: str, *, counts: bool) -> Outcome | None:
    """What comes when the timer ends after this input; None if there is no such, or it is not one that counts so."""
    model = moment.put_back()
    advanced = advance(model, INPUTS[name], now)
    if advanced is None or advanced[0].runs[0].handler not in COUNTING or is_unchanged(advanced[0]) is counts:
        return None
    ended = advance(model, INPUTS[TIMER], advanced[1])
    return None if ended is None else ended[0]


def in_short(outcome: Outcome) -> tuple[object, ...]:
    """What does not depend on which blocks there are."""
    return tuple((run.handler, run.branch, tuple(message.NAME for message in run.sent)) for run in outcome.runs)


def _too_much(model: Model, before: State, given: Input) -> bool:
    """What would only make more of the same, or is not told apart by the state."""
    if given.name == LOG:
        return len(model.state.blocks_to_be_committed) >= MOST_WAITING
    if before.doing != "voting" and "waits behind" in given.name:
        return True
    if given.tally != before.doing or "of an agent that has" in given.name:
        return False
    return _answers(model, before) >= 1 and (before.doing, before.holds) not in COUNTED_IN


def _answers(model: Model, before: State) -> int:
    """How many have been counted in what the agent does."""
    state = model.state
    match before.doing:
        case "voting":
            return len(state.voters)
        case "phase one":
            return sum(state.reconcile_vote_count.values())
    return sum(count for count, _ in state.reconcile_response_dictionary.values())
