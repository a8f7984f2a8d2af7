"""Test that the TLA+ specification and the real agents reach the same states and verdicts within the same bounds."""

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest

from harness.proof import Bounds, BoundsError
from harness.proof.specification import _spec_states, second_opinion
from harness.proof.specification import _tlc as tlc
from harness.scenario.agent_options import Stagger
from tests.harness.command import harness, sentences
from tests.machine import require_tlc

NO_GAP = {"finalize_gap_s": 0}


@pytest.fixture(autouse=True)
def _tlc() -> None:
    require_tlc()


@pytest.mark.parametrize(
    ("agents", "blocks", "network", "timers_any", "settings", "states"),
    [
        (2, 2, "lossy", True, {}, 341),
        (2, 3, "lossless", True, {}, 373),
        (2, 3, "lossless", False, NO_GAP, 325),
        (2, 4, "lossless", False, NO_GAP, 2949),
        (3, 1, "lossy", True, {}, 61),
        (3, 2, "lossless", True, {"phase2_tie": "block", "vote_names_chain": True}, 106),
    ],
)
def test_agent_and_specification_reach_equal_states(
    agents: int, blocks: int, network: Any, timers_any: bool, settings: dict[str, Any], states: int
) -> None:
    opinion = second_opinion(Bounds(agents, blocks, network, timers_any=timers_any, settings=settings))
    assert (opinion.states, opinion.specified) == (states, states)
    assert opinion.distinct == states or not timers_any
    assert opinion.agrees
    assert "✔ they are the same states" in opinion.in_words()
    livelock = None if network == "lossy" else blocks == 4
    assert (opinion.livelock, opinion.specified_livelock) == (livelock, livelock)
    assert opinion.exit_status == bool(livelock)


@pytest.mark.parametrize(
    ("agents", "blocks", "network", "timers_any", "states"),
    [(2, 3, "lossless", True, 117), (2, 4, "lossless", False, 487), (2, 2, "lossy", True, 329)],
)
def test_agent_and_specification_reach_equal_states_without_crossing(
    agents: int, blocks: int, network: Any, timers_any: bool, states: int
) -> None:
    bounds = Bounds(agents, blocks, network, timers_any=timers_any, settings=NO_GAP, crossing=False)
    opinion = second_opinion(bounds)
    assert (opinion.states, opinion.specified) == (states, states)
    assert opinion.agrees
    assert opinion.to_json()["crossing"] is False
    assert opinion.livelock is opinion.specified_livelock is (None if network == "lossy" else False)


def test_different_timers_give_equal_states_without_a_livelock() -> None:
    """If all timers are equal, both the agents and the specification have an endless cycle."""
    stagger: Stagger = {"phase1_timeout_s": 2.5}
    opinion = second_opinion(Bounds(2, 4, "lossless", settings=NO_GAP, stagger=stagger))
    assert (opinion.states, opinion.specified) == (2627, 2627)
    assert opinion.agrees
    assert opinion.livelock is opinion.specified_livelock is False
    assert opinion.to_json()["stagger"] == stagger


def test_misprints_of_the_thesis_are_rejected_by_both() -> None:
    opinion = second_opinion(Bounds(2, 2, "lossless", timers_any=True, quirks={"change_without_new_vote": True}))
    assert (opinion.flaw, opinion.violated) == ("2", "2")
    assert opinion.exit_status == 1


def test_wrong_specification_has_other_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in tlc.MODULES.glob("*.tla"):
        shutil.copy(path, tmp_path)
    protocol = tmp_path / "UCP.tla"
    wrong = protocol.read_text().replace("approved == a.voteCount.yes > ", "approved == a.voteCount.yes >= ")
    assert wrong != protocol.read_text()
    protocol.write_text(wrong)
    monkeypatch.setattr(tlc, "MODULES", tmp_path)
    opinion = second_opinion(Bounds(2, 2, "lossy", timers_any=True))
    assert not opinion.agrees
    assert opinion.only_real
    assert opinion.only_specified
    assert opinion.exit_status == 1


def test_command_compares_the_proof_with_tlc(tmp_path: Path) -> None:
    done = harness("prove", "--agents", "1", "--blocks", "1", "--second-opinion", "--json")
    assert done.returncode == 0
    document = json.loads(done.stdout)
    assert document["agree"]
    assert document["tlc"]["states"] == document["prove"]["states"]
    done = harness("prove", "--faults", "death", "--second-opinion")
    assert done.returncode == 2
    assert sentences(done.stderr) == ["the specification has no faults: leave out --faults"]


@pytest.mark.parametrize("setting", ["asks_after_commit", "top_needs_majority"])
def test_second_opinion_refuses_a_setting_that_the_specification_lacks(setting: str) -> None:
    done = harness("prove", "--second-opinion", "--settings", f"{setting}=true")
    assert done.returncode == 2
    assert sentences(done.stderr) == [
        f"the specification does not have the setting {setting}: leave out --settings {setting}=..."
    ]


def test_second_opinion_refuses_settings_that_the_specification_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "Swarm.tla").write_text((tlc.MODULES / "Swarm.tla").read_text().replace("Phase1TiePops", "Other"))
    monkeypatch.setattr(_spec_states, "MODULES", tmp_path)
    with pytest.raises(BoundsError, match="does not have the setting phase1_tie"):
        second_opinion(Bounds(settings={"phase1_tie": "pop"}))


def test_sizes_of_blocks_and_events_lead_to_the_same_states() -> None:
    for settings in ({"max_block_bytes": 1000}, {"max_event_bytes": 100}):
        assert second_opinion(Bounds(2, 1, settings=settings)).agrees


def test_sigterm_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tlc, "command", lambda memory_mb: ["sh", "-c", "kill -TERM $PPID; exec sleep 60"])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt), tlc.checked("Swarm", ""):
        pass
    assert not [*tmp_path.iterdir()]


def test_missing_java_error_names_the_package_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    done = harness("prove", "--second-opinion")
    assert done.returncode == 3
    [sentence] = sentences(done.stderr)
    assert "apt-get install default-jre-headless" in sentence
