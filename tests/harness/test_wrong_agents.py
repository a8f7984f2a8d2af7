"""Test the table in docs/appendix/wrong-agents.md: every deliberate error is found, and repeated trials give the same
results.
"""

from functools import cache

import pytest

from docs.generate.wrong_agents.trials_page import NOTHING, PAGE, findings_of, first_found, row, rows_of
from docs.generate.wrong_agents.wrong_trial import MISSIONS, Trial, judged, play
from harness.checker import Result
from harness.checker.judgement import Finding, Judgement
from ucp.quirks import QUIRKS

ROWS = rows_of(PAGE.read_text(encoding="utf-8"))


@cache
def right(seed: int) -> Trial:
    """Play the mission with correct agents. The result is cached, because several tests need it."""
    return play(None, seed)


def cells(quirk: str) -> list[str]:
    return [cell.strip() for cell in ROWS[quirk].strip().strip("|").split(" | ")]


def test_table_has_one_row_for_each_quirk() -> None:
    assert list(ROWS) == list(QUIRKS), "write it again: python -m docs.generate.wrong_agents.trials_page"


def test_every_quirk_is_found() -> None:
    assert not [quirk for quirk, line in ROWS.items() if NOTHING in line], "a hole: mend the hole"


@pytest.mark.parametrize("quirk", QUIRKS)
def test_first_finding_of_a_quirk_repeats(quirk: str) -> None:
    first = cells(quirk)[-1]
    seed = int(first.removeprefix("seed ").split(":")[0])
    assert first_found(seed, findings_of(play(quirk, seed), right(seed))) == first


def test_verdict_against_the_right_agent_is_no_finding() -> None:
    assert findings_of(Trial({"5": 60.0, "2": 9.0}, None), Trial({"5": 70.0}, None)) == {"2": 9.0}


def test_row_lists_the_checks_that_found_the_quirk() -> None:
    good, other = "vote_timer_expiration", "receive_commit_block"
    unharmed = {seed: Trial({}, None) for seed in (1, 2, 3, 4)}
    wrong = {
        1: Trial({}, None),
        2: Trial({"steps": 60.0, "2": None}, good),
        3: Trial({"steps": 180.0, "1": 120.0}, good),
        4: Trial({"steps": 600.0}, other),
    }
    sentence = QUIRKS["hide_commits"].sentence
    assert row("hide_commits", wrong, unharmed) == (
        f"| `hide_commits` | 5 | {sentence} | steps (3), 1 (1), 2 (1) | 3 | 2.0 | `{good}` | 2 of 3 "
        "| seed 2: steps, 2 |\n"
    )
    assert NOTHING in row("hide_commits", unharmed, unharmed)


def test_trial_has_time_and_handler_of_the_earliest_evidence() -> None:
    early = Finding(2, "trace line 7, t=12.5 s: it sent nothing", handler="build_data_block")
    late = Finding(1, "trace line 9, t=90 s: it sent nothing", handler="reconcile_finalize")
    steps = Judgement("every step", "deviates", "2 times", [early, late])
    idle = Judgement("idle", "violated", "1 time", [Finding(3, "block 3.1 is in no chain")])
    result = Result({"1": Judgement("distributed", "holds", ""), "2": idle}, {}, {"steps": steps})
    assert judged(result) == Trial({"2": None, "steps": 12.5}, "build_data_block")


def test_page_names_every_mission() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert [mission for mission in MISSIONS if f"[{mission.stem}](" not in page] == []
