"""Which tests take which branch of the 20 event handlers; `python -m tests.ucp.branches` writes it down.

A test names the branches that it is about, `@takes("vote_timer_expiration", "approved", "chain changed")`, and fails
if no agent takes them while it runs (`conftest.py`). `test_branches.py` fails while a branch has no such test.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import ucp
from ucp.agent import HANDLERS
from ucp.handler import EventHandler

Branch = tuple[str, str]
"""(handler, branch)"""

PAGE = Path(ucp.__path__[0]) / "contract" / "BRANCHES.md"

INTRODUCTION = """\
# The branches of the event handlers, and their tests

A handler ends in one of the branches that it declares; a trace names the handler and the branch of each of its runs.
Here is each branch of Algorithms 1-20, with the tests in [tests/ucp](../../tests/ucp) that take it and pin what it
does. A test that does not take its branches fails, and a branch without a test fails `make test`.

This page is written by `python -m tests.ucp.branches`.

"""

TABLE = """\
| Algorithm | handler | branch | when | tests |
|---|---|---|---|---|
"""

OF_WRONG_AGENTS = """
## Of wrong agents

An agent with [quirks](../quirks) has wrong handlers in the place of some of these. Besides their branches they take
two: "ignored by quirk", where `ignore_commit` strikes, and "crashed by quirk", where a handler ended by an exception.
"""

WHEN: dict[str, dict[str, str]] = {
    "build_data_block": {
        "building": "another event of the largest size still fits the current block",
        "full": "it might not fit any more",
    },
    "process_next_deque_block": {
        "reconcile in progress": "the agent reconciles",
        "vote running": "the vote on an earlier proposal is not over",
        "deque empty": "no block waits",
        "proposed": "a block waits and nothing stands in its way",
    },
    "receive_request_add_block": {
        "reconcile in progress": "the agent reconciles",
        "approve": "the proposer's top chain hash is the agent's own",
        "disapprove": "it is another",
    },
    "receive_vote_add_block": {
        "no vote running": "the agent has no vote running",
        "another block": "the vote is not for the agent's candidate",
        "another round": "with `vote_names_chain`: the vote is for the candidate, on top of another chain",
        "counted already": "the responder has voted in this round",
        "yes": "the responder approves",
        "no": "the responder disapproves",
    },
    "vote_timer_expiration": {
        "reconcile in progress": "the agent has begun to reconcile since it proposed",
        "chain changed": "the chain has changed since, and more approve than not (`changed_before_tally`: or fewer)",
        "approved": "more approve than disapprove, and the chain is the same",
        "not approved": "anything else",
    },
    "receive_commit_block": {
        "reconcile in progress": "the agent reconciles",
        "does not succeed": "the block does not go on top of the agent's chain",
        "held already": "it does, but the agent holds it already",
        "committed": "it goes on top of the agent's chain",
    },
    "reconcile_begin": {
        "already in progress": "the agent reconciles",
        "begun": "it does not yet",
    },
    "reconcile_phase_1": {"asked": "always"},
    "receive_request_chain_contain": {
        "reconcile in progress": "the agent reconciles",
        "yes": "its chain contains the chain hash",
        "no": "its chain does not",
    },
    "receive_phase_1_response": {
        "not in phase 1": "the phase 1 timer does not run",
        "another chain": "the response is not about the agent's top chain hash",
        "counted already": "the responder has answered this query",
        "yes": "the responder contains the chain hash",
        "no": "the responder does not",
    },
    "reconcile_phase_1_timer_expiration": {
        "no response": "nobody answered",
        "not contained": "more say no than yes (`phase1_tie: pop`: or as many)",
        "at inception": "the same, but only the inception block is left",
        "contained": "anything else: this is the mutual chain",
    },
    "reconcile_phase_2": {"asked": "always"},
    "receive_request_next_in_sequence": {
        "reconcile in progress": "the agent reconciles",
        "top of chain": "the chain hash is that of the agent's top block",
        "successor": "it is that of a block further down",
        "diverged": "the agent's chain does not contain it",
    },
    "receive_response_next_in_sequence": {
        "not in phase 2": "the phase 2 timer does not run",
        "another chain": "the response is not about the agent's top chain hash",
        "counted already": "the responder has answered this query",
        "new candidate": "nobody has given this answer before",
        "counted": "somebody has",
    },
    "reconcile_phase_2_timer_expiration": {
        "no response": "nobody answered",
        "top of chain": "most say that the chain ends here (`top_needs_majority`: and a vote would be approved)",
        "block": "most name one and the same block",
        "tie: top of chain": "a tie, and the oldest answer is that the chain ends here",
        "tie: block": "a tie, and the oldest answer is a block (`phase2_tie: block`: some answer is)",
    },
    "reconcile_phase_3": {
        "from the stack": "the block is on the reconcile stack",
        "held already": "it is in the agent's chain or deque",
        "asked": "the agent does not have it",
    },
    "receive_request_block_for_hash": {
        "reconcile in progress": "the agent reconciles",
        "sent": "its chain has the block",
        "not held": "its chain does not",
    },
    "receive_response_block_for_hash": {
        "not in phase 3": "the phase 3 timer does not run",
        "another block": "the block is not the one that the agent asked for",
        "committed": "it is",
    },
    "reconcile_phase_3_timer_expiration": {"gave up": "always: the block did not come"},
    "reconcile_finalize": {
        "asked who follows": "with `asks_after_commit`: a gap after a commit of its own; it does not reconcile",
        "recommitted, more to come": "one block is back, more are on the stack, and `finalize_gap_s` is not 0",
        "done": "the stack is empty",
    },
}


def takes(handler: str, *branches: str) -> pytest.MarkDecorator:
    """The test takes these branches of `handler`. Can be given repeatedly, and as `marks` to one `pytest.param`."""
    return pytest.mark.branch(handler=handler, branches=branches)


def declared(marks: Iterable[pytest.Mark | pytest.MarkDecorator]) -> set[Branch]:
    """The branches that a test with these marks takes."""
    taken = (mark.kwargs for mark in marks if mark.name == "branch")
    return {(branches["handler"], branch) for branches in taken for branch in branches["branches"]}


@contextmanager
def recorded() -> Iterator[set[Branch]]:
    """The branches that the agents take meanwhile."""
    taken: set[Branch] = set()

    def recording(handler: EventHandler[Any]) -> Callable[..., str]:
        run = vars(handler)["run"]

        @wraps(run)
        def record(*inputs: Any) -> str:
            branch: str = run(*inputs)
            taken.add((handler.name, branch))
            return branch

        return record

    with pytest.MonkeyPatch.context() as patch:
        run = property(recording, lambda handler, run: vars(handler).update(run=run))
        patch.setattr(EventHandler, "run", run, raising=False)  # goes before the instance's `run`
        yield taken


def taken_by() -> dict[Branch, list[str]]:
    """The tests in this folder that take each branch; one that may be skipped or is expected to fail does not count."""
    tests: dict[Branch, list[str]] = {}
    for path in sorted(Path(__file__).parent.glob("test_*.py")):
        for name, test in _tests_in(import_module(f"{__package__}.{path.stem}")):
            marks = list(_marks_of(test))
            if not {"skip", "skipif", "xfail"} & {mark.name for mark in marks}:
                for branch in declared(marks):
                    tests.setdefault(branch, []).append(f"{path.name}::{name}")
    return tests


def _tests_in(place: ModuleType | type) -> Iterator[tuple[str, object]]:
    for name, value in vars(place).items():
        if name.startswith("test_"):
            yield name, value
        elif name.startswith("Test") and isinstance(value, type):
            yield from ((f"{name}::{method}", test) for method, test in _tests_in(value))


def _marks_of(test: object) -> Iterator[pytest.Mark | pytest.MarkDecorator]:
    for mark in getattr(test, "pytestmark", ()):
        yield mark
        if mark.name == "parametrize":
            for case in mark.args[1]:
                yield from getattr(case, "marks", ())


def branches_of(handlers: Iterable[EventHandler[Any]]) -> list[Branch]:
    return [(handler.name, branch) for handler in handlers for branch in handler.branches]


def page() -> str:
    tests = taken_by()

    def rows() -> Iterator[str]:
        for name, branches in WHEN.items():
            cells = f"{HANDLERS[name].title} | `{name}`"
            for branch, reason in branches.items():
                named = "<br>".join(f"`{test}`" for test in tests.get((name, branch), ()))
                yield f"| {cells} | {branch} | {reason} | {named} |\n"
                cells = " | "

    return INTRODUCTION + TABLE + "".join(rows()) + OF_WRONG_AGENTS


if __name__ == "__main__":
    PAGE.write_text(page())
