"""Test the comparison of the agent core with the specification, and whether it detects planted mistakes."""

import pytest

from tests.harness.proof.specification.mutation.comparisons import (
    Comparison,
    DirectedInputs,
    Inputs,
    RandomInputs,
    States,
)
from tests.harness.proof.specification.mutation.edits import edits, specification
from tests.harness.proof.specification.mutation.reasons import violated_in
from tests.harness.proof.specification.mutation.score import BEGIN, COMPARISONS, END, PAGE, digest, stored, tables
from tests.machine import require_tlc

AGAIN = "run `python -m tests.harness.proof.specification.mutation`"
SMALL = next(
    comparison for comparison in COMPARISONS if isinstance(comparison, States) and comparison.bounds.agents > 2
)
DIRECTED = next(each for each in COMPARISONS if isinstance(each, DirectedInputs))
RANDOM = next(each for each in COMPARISONS if isinstance(each, RandomInputs))
STACK = next(edit for edit in edits() if edit.name == "16: the top of the stack is removed")


def test_score_is_that_of_this_specification() -> None:
    results = stored()
    assert {edit.name: digest(edit) for edit in edits()} == {name: result.text for name, result in results.items()}, (
        AGAIN
    )
    assert PAGE.read_text("utf-8").partition(BEGIN)[2].partition(END)[0].strip() == tables().strip(), AGAIN


def test_each_algorithm_has_five_mistakes_or_more() -> None:
    for algorithm in range(21):
        assert sum(edit.algorithm == algorithm for edit in edits()) >= 5


def test_each_mistake_is_found_or_has_a_reason() -> None:
    results = stored()
    assert [edit.name for edit in edits() if (results[edit.name].by is None) != (edit.reason is not None)] == []


@pytest.mark.parametrize("comparison", [SMALL, RANDOM], ids=lambda comparison: comparison.name)
def test_reasons_hold_in_the_specification(comparison: States | Inputs) -> None:
    require_tlc()
    assert violated_in(comparison, [edit.reason.always for edit in edits() if edit.reason]) is None


def test_false_reason_is_refused() -> None:
    """The directed inputs put two blocks on the stack, so the reason is false."""
    require_tlc()
    assert violated_in(DIRECTED, ["Len(a.triggered) <= 1", "Len(a.reconcileStack) <= 1"]) == 1


def test_edit_of_changed_text_is_refused() -> None:
    with pytest.raises(ValueError, match="has this text 0 times"):
        edits()[0].applied(specification().replace("InceptionChainHash", "Other"))


@pytest.mark.parametrize("comparison", COMPARISONS, ids=lambda comparison: comparison.name)
def test_core_and_specification_agree(comparison: Comparison) -> None:
    require_tlc()
    assert comparison.differences([specification()]) == [None]


def test_comparison_of_states_finds_mistakes() -> None:
    require_tlc()
    text, first = specification(), COMPARISONS[0]
    found = [edit for edit in edits() if stored()[edit.name].by == first.name]
    by_difference = {stored()[edit.name].difference: edit for edit in found}
    differences = first.differences([text, *(edit.applied(text) for edit in by_difference.values()), text])
    assert differences == [None, *by_difference, None]


def test_comparison_of_steps_finds_mistake() -> None:
    require_tlc()
    assert DIRECTED.differences([STACK.applied(specification())]) == ["other steps"]
