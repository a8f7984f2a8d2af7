"""Test the computation of survival in runs with known results.

It computes which blocks survive the loss of vehicles, and which further losses a swarm can bear.
"""

from pathlib import Path
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.archive.run_record import Loss, Survival
from harness.checker import Evidence, gather
from harness.checker.survival import in_words, survival
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import simulate
from harness.scenario import load_scenario
from tests.harness.virtual import scenario

ONE_EVENT_ONE_BLOCK = {"max_block_bytes": 267, "max_event_bytes": 267}
PAIRS = {"at_s": 0, "partition": [[1, 2], [3, 4]]}
ATTRITION = Path(__file__).parents[3] / "scenarios" / "attrition.yaml"


def evidence(timeline: list[dict[str, Any]], *, tracing: bool = True, **keys: Any) -> Evidence:
    """Play a run in which agent 1 completes a block at 10 s, and agent 3 at 15 s. Receivers commit each block 10 s
    later.
    """
    script = [{"at_s": 10, "agent": 1}, {"at_s": 15, "agent": 3}]
    one = scenario(
        agents=4,
        duration_s=300,
        events={"source": "scripted", "script": script},
        settings=ONE_EVENT_ONE_BLOCK,
        timeline=timeline,
        **keys,
    )
    return simulate(one, 1, tracing=tracing).evidence


def counts(loss: Loss) -> tuple[int | None, ...]:
    return loss.completed, loss.survived, loss.gone, loss.gone_at_end


def test_block_that_only_lost_vehicles_held_is_gone() -> None:
    survived = survival(evidence([PAIRS, {"at_s": 100, "kill": [1, 2]}, {"at_s": 110, "heal": True}]))
    (loss,) = survived.losses
    assert (loss.at_s, loss.what, loss.vehicles) == (100, "kill", [1, 2])
    assert counts(loss) == (2, 1, 1, 1)
    (block,) = loss.blocks
    assert (block.agent_id, block.holders, block.holders_at_end) == (1, [], [])
    assert (survived.completed, survived.gone) == (2, 1)
    assert survived.at_end is not None
    assert (survived.at_end.holders, survived.at_end.vehicles, survived.at_end.of) == ([3, 4], 2, 1)


def test_block_survives_on_other_vehicles_until_they_are_lost() -> None:
    survived = survival(evidence([PAIRS, {"at_s": 100, "crash": [1]}, {"at_s": 200, "kill": [2]}]))
    first, second = survived.losses
    assert counts(first) == (2, 2, 0, 1)
    assert (first.blocks[0].holders, first.blocks[0].holders_at_end) == ([2], [])
    assert counts(second) == (2, 1, 1, 1)
    assert [block.agent_id for block in second.blocks] == [1]


def test_only_its_maker_holds_a_block_before_the_commit() -> None:
    survived = survival(evidence([{"at_s": 18, "kill": [1]}]))
    assert counts(survived.losses[0]) == (2, 1, 1, 1)
    at_once = survival(evidence([{"at_s": 12, "kill": [3]}]))
    assert counts(at_once.losses[0]) == (1, 1, 0, 0)


def test_block_completed_at_the_instant_of_a_loss_counts() -> None:
    survived = survival(evidence([{"at_s": 10, "kill": [2]}]))
    assert counts(survived.losses[0]) == (1, 1, 0, 0)


@pytest.mark.parametrize(("disk", "gone"), [("kept", [0]), ("lost", [0, 1])])
def test_kept_disk_of_a_rebooting_vehicle_counts(disk: str, gone: list[int]) -> None:
    reboot = {"at_s": 100, "reboot": [2], "down_s": 50, "disk": disk}
    survived = survival(evidence([PAIRS, reboot, {"at_s": 120, "kill": [1]}]))
    assert [loss.gone for loss in survived.losses] == gone


def test_restarted_vehicle_holds_no_earlier_blocks() -> None:
    back = [{"at_s": 50, "kill": [2]}, {"at_s": 60, "restart": [2]}]
    survived = survival(evidence([PAIRS, *back, {"at_s": 100, "kill": [1]}]))
    assert [loss.gone for loss in survived.losses] == [0, 1]


def test_next_loss_is_that_of_the_block_with_the_fewest_holders() -> None:
    survived = survival(evidence([{"at_s": 0, "partition": [[1], [2, 3, 4]]}], final_reconcile=True))
    before, after = survived.before_final_reconcile, survived.at_end
    assert before is not None and after is not None
    assert (before.holders, before.block, before.blocks, before.of, before.vehicles) == ([1], "1.1", 1, 2, 4)
    assert (after.holders, after.blocks, after.of) == ([1, 2, 3, 4], 2, 2)
    assert not survived.losses


def test_only_the_end_is_known_without_all_traces() -> None:
    survived = survival(evidence([PAIRS, {"at_s": 100, "kill": [1, 2]}], tracing=False))
    assert counts(survived.losses[0]) == (None, None, None, None)
    assert survived.gone == 1
    assert "the traces do not show which blocks were lost" in in_words(survived)[0]


def test_empty_evidence_has_no_losses() -> None:
    assert survival(Evidence({})) == Survival(completed=0, gone=0)
    assert in_words(Survival(completed=0, gone=0)) == []


def test_survival_is_described_in_words() -> None:
    assert in_words(survival(evidence([PAIRS, {"at_s": 100, "kill": [1, 2]}]))) == [
        "at 100 s vehicles 1 and 2 were lost (kill), and with them 1 of 2 completed blocks",
        "at the end 1 of 2 completed blocks is gone",
        "the block is on all 2 vehicles",
    ]
    assert in_words(survival(evidence([PAIRS, {"at_s": 100, "crash": [2]}]))) == [
        "at 100 s vehicle 2 was lost (crash), and with it none of 2 completed blocks",
        "at the end none of 2 completed blocks is gone",
        "losing vehicle 1 would lose block 1.1",
    ]
    assert in_words(survival(evidence([PAIRS]))) == [
        "losing any one vehicle loses no block; "
        "losing vehicles 1 and 2 would lose block 1.1, and 2 of 2 blocks are on as few vehicles"
    ]
    many = [{"at_s": 20.0 * n, what: [4]} for n in range(1, 15) for what in (("kill", "restart")[(n + 1) % 2],)]
    assert in_words(survival(evidence(many)))[5] == "2 more losses of vehicles are in run.json"


def test_attrition_scenario_shows_survival_also_from_its_directory(tmp_path: Path) -> None:
    one = load_scenario(ATTRITION)
    finished = run(one, 2, tmp_path / "run", SilentProgress(), "sim")
    assert finished.exit_status == 0
    assert [(loss.what, loss.vehicles) for loss in finished.survival.losses] == [
        ("kill", [2]),
        ("crash", [4]),
        ("reboot", [6]),
    ]
    assert all(loss.blocks for loss in finished.survival.losses)
    assert finished.survival == survival(simulate(one, 2, tracing=True).evidence)
    assert finished.survival == survival(gather(RunArchive(tmp_path / "run")))
    assert "Survival" in finished.report.read_text(encoding="utf-8")
