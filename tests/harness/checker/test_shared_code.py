"""Test which modules of `ucp` the checker uses, and that these modules pass the test vectors of the agent contract."""

from collections.abc import Iterator

import pytest

from harness.archive import vocabulary
from harness.checker.judgement import Judgement
from harness.checker.reference import algorithms
from harness.checker.steps import _shared_code, first_cause
from tests.harness.test_rooms import imports, modules
from ucp.agent import HANDLERS, ON_MESSAGE, ON_TIMER
from ucp.quirks import CRASHED, QUIRKS

LANGUAGE = {"ucp.block", "ucp.events", "ucp.messages", "ucp.plain_file", "ucp.sealed", "ucp.trace", "ucp.trigger"}
"""The modules of `ucp` that the checker may import. They define the messages and files of agents."""
NOT_THE_JUDGE = {
    "harness.checker.steps.core_in_use": "it plays the installed core for a debugger, and judges no agent",
    "harness.checker.steps._shared_code": "it checks the settings, and the judge does not use them",
}
READS_FOR_THE_JUDGE = {"harness.archive.traces", "harness.archive.vocabulary", "harness.checker.recorded_inputs"}


def judge() -> Iterator[str]:
    """Yield the modules that judge the steps of agents: the reference implementation, the comparison of steps, and the
    readers of the records.
    """
    rooms = ("harness.checker.reference", "harness.checker.steps")
    yield from (name for name in modules() if name.startswith(rooms) and name not in NOT_THE_JUDGE)
    yield from READS_FOR_THE_JUDGE


def of_ucp(names: frozenset[str]) -> set[str]:
    return {name for name in names if name.startswith("ucp.")}


def test_judge_imports_only_the_language_of_the_agents() -> None:
    assert set[str]().union(*(of_ucp(imports(name)) for name in judge())) == LANGUAGE


def test_language_imports_no_other_code_of_the_agents() -> None:
    reached, left = set[str](), [*LANGUAGE]
    while left:
        name = left.pop()
        reached.add(name)
        left += of_ucp(imports(name)) - reached
    assert reached == {f"ucp.{name}" for name in _shared_code.SHARED}


def test_shared_code_contradicts_no_vector() -> None:
    assert [*_shared_code._contradictions()] == []


def test_released_code_needs_no_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_shared_code, "edited_files", lambda: ("ucp/commit.py",))
    assert _shared_code.edited.__wrapped__() == ()
    monkeypatch.setattr(_shared_code, "edited_files", lambda: ("ucp/commit.py", "ucp/wire.py"))
    assert _shared_code.edited.__wrapped__() == ("ucp/wire.py",)


def test_names_of_the_judge_are_those_of_core_and_reference() -> None:
    of_quirks = {
        name: {
            branch for quirk in QUIRKS.values() if handler.algorithm in quirk.algorithms for branch in quirk.branches
        }
        for name, handler in HANDLERS.items()
    }
    assert {
        name: {*handler.branches, *of_quirks[name], CRASHED} for name, handler in HANDLERS.items()
    } == vocabulary.BRANCHES
    assert {handler.name: timer for timer, handler in ON_TIMER.items()} == vocabulary.TIMER_OF
    assert {handler.name: timer for timer, handler in algorithms.ON_TIMER.items()} == vocabulary.TIMER_OF
    assert {message.NAME for message in ON_MESSAGE} == vocabulary.MESSAGES
    votes = ("vote_count", "reconcile_vote_count")
    assert {name for name, handler in HANDLERS.items() if handler.tally in votes} == vocabulary.COUNTS_VOTES


def test_deviation_without_a_handler_has_no_cause_if_no_file_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Judgement("every step", "deviates", "ucp/block.py was edited and contradicts the agent contract")
    assert first_cause(broken) is None
    monkeypatch.setattr(_shared_code, "broken_files", lambda: "ucp/block.py")
    assert first_cause(broken) == "ucp/block.py"
