"""Test that all included scenarios give the same chains with keys as without keys."""

import sys
from pathlib import Path

import pytest

from benchmarks import secured_library
from benchmarks.secured_library import all_of, compare, in_both, main
from harness.scenario import Scenario
from tests.harness.virtual import scenario


def test_scenarios_of_every_kind_have_the_same_chains_with_keys() -> None:
    asked = list(
        all_of(["attrition", "late_joiner", "loss_30", "revoked_in_partition", "rolling_partitions", "secure"])
    )
    assert compare(asked, range(1, 2), 1) == {}
    exceptions = {name: without for name, _, without in asked if without}
    assert exceptions == {
        "attrition": (secured_library.RESTARTS,),
        "late_joiner": (secured_library.RESTARTS,),
        "revoked_in_partition": (secured_library.REVOCATIONS, secured_library.RESTARTS),
        "secure": (secured_library.INJECTIONS,),
    }


def test_matrix_is_compared_at_each_of_its_rates() -> None:
    names = [name for name, _, _ in all_of(["thesis_matrix"])]
    assert len(names) == 8
    assert names[-1] == "thesis_matrix, loss 1"


def test_sealing_is_left_out_because_it_changes_hashes() -> None:
    sealing = scenario(security={"seal": True})
    assert in_both("mine", sealing).without == (secured_library.SEALING,)


def test_different_chains_give_the_scenario_and_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("name: Mine\nagents: 2\nduration_s: 120\nevents: {mean_s: 5}\n")
    secured = Scenario.secured
    monkeypatch.setattr(Scenario, "secured", lambda it: secured(it.model_copy(update={"duration_s": 60})))
    monkeypatch.setattr(sys, "argv", ["secured_library", "--seeds", "2", "--jobs", "1", str(mine)])
    assert main() == 1
    output = capsys.readouterr().out
    assert f"{mine} different\n    seed 1: agent 1 has other blocks from block" in output
    assert "1 scenarios with 2 seeds, 1 different" in output


def test_invalid_scenario_file_causes_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["secured_library", str(tmp_path / "nothing.yaml")])
    assert main() == 2
    assert capsys.readouterr().err.count("\n") == 1
