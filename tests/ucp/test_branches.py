"""Test that each branch of each event handler has a test, and that the page of branches is up to date."""

from tests.ucp.air import Air
from tests.ucp.branches import PAGE, WHEN, branches_of, page, recorded, taken_by
from ucp.agent import HANDLERS

BRANCHES = branches_of(HANDLERS.values())


def test_every_branch_has_a_test() -> None:
    assert not {*BRANCHES} - taken_by().keys(), "mark a test with @takes(handler, branch)"


def test_every_declared_branch_exists() -> None:
    assert not taken_by().keys() - {*BRANCHES}, "no handler has them"


def test_every_branch_has_a_condition_on_the_page() -> None:
    assert [(handler, branch) for handler, reasons in WHEN.items() for branch in reasons] == BRANCHES


def test_page_names_existing_tests() -> None:
    assert PAGE.read_text() == page(), "write it again: python -m tests.ucp.branches"


def test_taken_branches_are_recorded_only_inside_the_context() -> None:
    air = Air([1], fate=lambda *_: [])
    with recorded() as taken:
        air.log(1)
    assert taken == {("build_data_block", "building")}
    air.fill_block(1)
    assert len(taken) == 1
