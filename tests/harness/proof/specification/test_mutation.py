"""The comparison of agent core and specification, and the mistakes in the specification that it finds."""

import pytest

from tests.harness.proof.specification.mutation.comparisons import Comparison, RandomInputs
from tests.harness.proof.specification.mutation.edits import edits, specification
from tests.harness.proof.specification.mutation.score import BEGIN, COMPARISONS, END, PAGE, digest, stored, tables
from tests.machine import require_tlc

AGAIN = "run `python -m tests.harness.proof.specification.mutation`"
RANDOM = next(comparison for comparison in COMPARISONS if isinstance(comparison, RandomInputs))
GATE = COMPARISONS[:-2]
"""All comparisons but the two with the most states, which take a minute."""
VOTES = next(edit for edit in edits() if edit.name == "4: yes and no are exchanged")


def test_score_is_that_of_this_specification() -> None:
    results = stored()
    assert {edit.name: digest(edit) for edit in edits()} == {name: result.text for name, result in results.items()}, (
        AGAIN
    )
    assert PAGE.read_text("utf-8").partition(BEGIN)[2].partition(END)[0].strip() == tables().strip(), AGAIN


def test_each_algorithm_has_five_mistakes_or_more() -> None:
    for algorithm in range(21):
        assert sum(edit.algorithm == algorithm for edit in edits()) >= 5


def test_edit_of_changed_text_is_refused() -> None:
    with pytest.raises(ValueError, match="has this text 0 times"):
        edits()[0].applied(specification().replace("InceptionChainHash", "Other"))


@pytest.mark.parametrize("comparison", GATE, ids=lambda comparison: comparison.name)
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
    assert RANDOM.differences([VOTES.applied(specification())]) == ["other steps"]
