"""Each branch of each event handler has a test, and the page that names it is true."""

from tests.ucp.air import Air
from tests.ucp.branches import PAGE, WHEN, branches_of, page, recorded, taken_by
from ucp.agent import HANDLERS

BRANCHES = branches_of(HANDLERS.values())


def test_every_branch_has_a_test() -> None:
    assert not {*BRANCHES} - taken_by().keys(), "mark a test with @takes(handler, branch)"


def test_only_branches_that_exist_are_declared() -> None:
    assert not taken_by().keys() - {*BRANCHES}, "no handler has them"


def test_when_a_branch_is_taken_is_said_for_each_and_no_other() -> None:
    assert [(handler, branch) for handler, reasons in WHEN.items() for branch in reasons] == BRANCHES


def test_the_page_names_the_tests_that_there_are() -> None:
    assert PAGE.read_text() == page(), "write it again: python -m tests.ucp.branches"


def test_what_agents_take_is_recorded_only_meanwhile() -> None:
    air = Air([1], fate=lambda *_: [])
    with recorded() as taken:
        air.log(1)
    assert taken == {("build_data_block", "building")}
    air.fill_block(1)
    assert len(taken) == 1
