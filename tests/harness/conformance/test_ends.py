"""Test agents that hang or end after many inputs, and failures that cannot be repeated in virtual time."""

import sys
from pathlib import Path

import pytest

from harness.conformance import _udp_lab
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance.conformance_run import ConformanceRequest, conform, keep
from harness.conformance.results import CaseResult, ConformanceResults
from harness.conformance.results_table import lines_of
from harness.conformance.vectors import VectorSet
from harness.play.process import controlled_program
from tests.harness.conformance import wrong_programs


def results_of(mistake: str, place: Path, *, virtual: bool = False) -> ConformanceResults:
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.key: step for step in steps if step.before.activity == "idle" and len(step.path) <= 2}
    command = (sys.executable, "-P", "-m", wrong_programs.__name__, mistake)
    asked = ConformanceRequest(
        command, None, place / "kept", virtual=virtual, handwritten=False, max_suspicions=2, limit_s=60.0
    )
    return conform(asked, place, lambda count, total: None, [VectorSet(VARIANTS["default"], steps, wanted)])


@pytest.mark.lab
@pytest.mark.any_user
def test_agent_that_hangs_after_many_inputs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(controlled_program, "ANSWER_LIMIT_S", 3.0)
    monkeypatch.setattr(_udp_lab, "REPEATED_REQUEST_LIMIT_S", 0.3)
    results = results_of("hangs_after_20_inputs", tmp_path)
    assert results.exit_status == 1
    assert [case.algorithm for case in results.failures] == [0]
    assert results.failures[0].name.startswith("it hangs: it did not answer")


def test_agent_that_ends_after_many_inputs_is_named(tmp_path: Path) -> None:
    results = results_of("ends_after_50_inputs", tmp_path, virtual=True)
    assert results.exit_status == 1
    assert [case.name.partition(":")[0] for case in results.failures] == ["it ended by itself with status 3"]


def test_wrong_status_at_the_end_of_the_input_fails_its_case(tmp_path: Path) -> None:
    results = results_of("ends_with_status_3_without_a_mission", tmp_path, virtual=True)
    assert [case.reason for case in results.failures] == ["expected status 0 at the end of the input; came status 3"]


def test_failure_without_a_path_in_virtual_time_is_kept(tmp_path: Path) -> None:
    case = CaseResult("a late timer", 5, "failed", settings="default", inputs=("the next timer ends", "vote yes"))
    keep(case, ("agent",), tmp_path / "kept")
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["failure.txt"]
    assert "is impossible in virtual time" in (tmp_path / "kept" / "failure.txt").read_text()


def test_failure_without_files_is_reported(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("in the way")
    results = results_of("ends_after_50_inputs", tmp_path, virtual=True)
    assert results.failures and "cannot be written" in results.notes[-1]


def test_failure_without_messages_shows_its_reason_alone() -> None:
    case = CaseResult("it hangs", 0, "failed", reason="it hangs", wrong=("it hangs",))
    assert list(lines_of(case)) == ["the program: it hangs", "  it hangs"]
