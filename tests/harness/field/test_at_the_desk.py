"""Test that the table in docs/appendix/wrong-agents-field.md is complete and correct."""

from docs.generate.wrong_agents.at_the_desk import PAGE, AtTheDesk, Named, row
from docs.generate.wrong_agents.trials_page import rows_of
from ucp.quirks import QUIRKS

ROWS = rows_of(PAGE.read_text(encoding="utf-8"))


def test_each_quirk_has_a_row() -> None:
    assert list(ROWS) == list(QUIRKS), "write it again: python -m docs.generate.wrong_agents.at_the_desk"


def test_replay_finds_each_wrong_agent() -> None:
    assert not [quirk for quirk, line in ROWS.items() if "no difference" in line]


def test_row_has_the_first_difference_and_counts_correct_handlers() -> None:
    late = Named(120.0, "vote_timer_expiration", "it sent nothing; it should have sent Commit Block about block 2.1")
    early = Named(60.0, "receive_commit_block", "it took the branch 'a|b'")
    assert row("hide_commits", AtTheDesk(2, 5, (late, early))) == (
        "| `hide_commits` | 5 | `receive_commit_block` | 1 of 2 | 1.0 | 2 | `it took the branch 'a\\|b'` |\n"
    )
    assert "no difference" in row("hide_commits", AtTheDesk(8, 5, ()))
