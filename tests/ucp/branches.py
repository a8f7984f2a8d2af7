"""List the tests that take each branch of the 20 event handlers. `python -m tests.ucp.branches` writes BRANCHES.md.

A test declares its branches, for example `@takes("vote_timer_expiration", "approved", "chain changed")`. The test fails
if no agent takes these branches while it runs (`conftest.py`). `test_branches.py` fails if a branch has no such test.
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
"""A handler and one of its branches."""

PAGE = Path(ucp.__path__[0]) / "contract" / "BRANCHES.md"

INTRODUCTION = """\
# Branches of the event handlers

Each run of an event handler ends in one *branch*, a named case such as "approved". The handler declares its branches.
For each run, a trace records the handler and the branch. [The agent contract](CONTRACT.md#the-20-algorithms) contains
the algorithms, and [HANDLERS.md](HANDLERS.md) shows the cause of each handler.

This table lists each branch of Algorithms 1-20 with its condition. The last column lists the tests in
[tests/ucp](../../tests/ucp) in which an agent takes the branch, and which check the effect. A test fails if no agent
takes the branches that the test declares. `make test` fails if a branch has no test.

`python -m tests.ucp.branches` generates this page.

"""

TABLE = """\
| Algorithm | handler | branch | condition | tests |
|---|---|---|---|---|
"""

WRONG_AGENTS = """
## Branches of wrong agents

A [quirk](../quirks) is a deliberate mistake of an agent. A quirk replaces handlers of the agent with wrong
handlers. A wrong handler can take two additional branches:

| branch | condition |
|---|---|
| ignored by quirk | The quirk `ignore_commit` suppresses a commit in Algorithm 6. |
| crashed by quirk | The handler raised an exception. |
"""

WHEN: dict[str, dict[str, str]] = {
    "build_data_block": {
        "building": "another event of the largest size still fits the current block",
        "full": "another event of the largest size might not fit the current block",
    },
    "process_next_deque_block": {
        "reconcile in progress": "the agent reconciles",
        "vote running": "a vote of the agent is running",
        "deque empty": "the deque is empty",
        "proposed": "the deque has a block, and neither a vote nor a reconcile is running",
    },
    "receive_request_add_block": {
        "reconcile in progress": "the agent reconciles",
        "approve": "the proposer's top chain hash is the agent's own",
        "disapprove": "the proposer's top chain hash differs from the agent's own",
    },
    "receive_vote_add_block": {
        "no vote running": "the agent's voting timer does not run",
        "another block": "the vote is not for the agent's candidate",
        "another round": "only with `vote_names_chain`: the vote names another chain than the agent's proposal",
        "counted already": "the responder has already voted in this round",
        "yes": "the responder approves",
        "no": "the responder disapproves",
    },
    "vote_timer_expiration": {
        "reconcile in progress": "the agent started a reconcile after its proposal",
        "chain changed": "the chain changed, and more agents approve than not (`changed_before_tally`: any result)",
        "approved": "more agents approve than not, and the chain did not change",
        "not approved": "any other case",
    },
    "receive_commit_block": {
        "reconcile in progress": "the agent reconciles",
        "does not succeed": "the block's chain hash does not fit on top of the agent's chain",
        "held already": "the chain hash fits, but the agent already holds the block",
        "committed": "the chain hash fits, and the agent does not hold the block",
    },
    "reconcile_begin": {
        "already in progress": "the agent reconciles",
        "begun": "the agent does not reconcile",
    },
    "reconcile_phase_1": {"asked": "always"},
    "receive_request_chain_contain": {
        "reconcile in progress": "the agent reconciles",
        "yes": "the agent's chain contains the chain hash",
        "no": "the agent's chain does not contain the chain hash",
    },
    "receive_phase_1_response": {
        "not in phase 1": "the phase 1 timer does not run",
        "another chain": "the response is not about the agent's top chain hash",
        "counted already": "the responder has answered this query",
        "yes": "the responder's chain contains the chain hash",
        "no": "the responder's chain does not contain the chain hash",
    },
    "reconcile_phase_1_timer_expiration": {
        "no response": "no agent answered",
        "not contained": "more answers are no than yes (`phase1_tie: pop`: or a tie)",
        "at inception": "as 'not contained', but the chain has only the inception block",
        "contained": "any other case: the chain is mutual",
    },
    "reconcile_phase_2": {"asked": "always"},
    "receive_request_next_in_sequence": {
        "reconcile in progress": "the agent reconciles",
        "top of chain": "the chain hash is that of the agent's top block",
        "successor": "the chain hash is that of a lower block",
        "diverged": "the agent's chain does not contain the chain hash",
    },
    "receive_response_next_in_sequence": {
        "not in phase 2": "the phase 2 timer does not run",
        "another chain": "the response is not about the agent's top chain hash",
        "counted already": "the responder has answered this query",
        "new candidate": "no other responder has given this answer",
        "counted": "another responder has given the same answer",
    },
    "reconcile_phase_2_timer_expiration": {
        "no response": "no agent answered",
        "top of chain": "most frequent answer: Is Top Of Chain (`top_needs_majority`: and a vote would be approved)",
        "block": "most frequent answer: a block",
        "tie: top of chain": "a tie; the tied answer with the oldest timestamp is Is Top Of Chain",
        "tie: block": "a tie; the tied answer with the oldest timestamp is a block (`phase2_tie: block`: any tie)",
    },
    "reconcile_phase_3": {
        "from the stack": "the block is on the reconcile stack",
        "held already": "the block is in the agent's chain or deque",
        "asked": "the agent does not hold the block",
    },
    "receive_request_block_for_hash": {
        "reconcile in progress": "the agent reconciles",
        "sent": "the agent's chain has the block",
        "not held": "the agent's chain does not have the block",
    },
    "receive_response_block_for_hash": {
        "not in phase 3": "the phase 3 timer does not run",
        "another block": "the block is not the requested one",
        "committed": "the block is the requested one",
    },
    "reconcile_phase_3_timer_expiration": {"gave up": "always: the block did not arrive"},
    "reconcile_finalize": {
        "asked who follows": "with `asks_after_commit`: the gap after a commit ended, and the agent does not reconcile",
        "recommitted, more to come": "the agent committed one block, the stack has more, and `finalize_gap_s` is not 0",
        "done": "the stack is empty",
    },
}


def takes(handler: str, *branches: str) -> pytest.MarkDecorator:
    """Return a pytest marker which declares that a test takes these branches of `handler`.

    A test may have several such markers. A `pytest.param` may have the marker, too.
    """
    return pytest.mark.branch(handler=handler, branches=branches)


def declared(marks: Iterable[pytest.Mark | pytest.MarkDecorator]) -> set[Branch]:
    """Return the branches that a test with these markers declares."""
    taken = (mark.kwargs for mark in marks if mark.name == "branch")
    return {(branches["handler"], branch) for branches in taken for branch in branches["branches"]}


@contextmanager
def recorded() -> Iterator[set[Branch]]:
    """Yield the set of branches that agents take inside the context."""
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
        patch.setattr(EventHandler, "run", run, raising=False)  # replaces the `run` of the instance
        yield taken


def taken_by() -> dict[Branch, list[str]]:
    """Return, for each branch, the tests in this folder that take it. Tests that may be skipped do not count."""
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

    return INTRODUCTION + TABLE + "".join(rows()) + WRONG_AGENTS


if __name__ == "__main__":
    PAGE.write_text(page())
