"""Test scripted deliveries of single messages. They force situations that the experiments of the thesis could not
force.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from harness.errors import WRONG_REQUEST
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import load_scenario
from tests.harness.virtual import scenario
from ucp.trigger import MessageTrigger

SCENARIOS = Path(__file__).parents[3] / "scenarios"

BLOCK_OF_1 = [{"at_s": at_s, "agent": 1} for at_s in (1, 2, 3)]
"""Three events of 256 bytes. They complete block 1.1, which is proposed at second 3 and committed at second 13."""


def played(
    fates: list[dict[str, Any]], script: list[dict[str, Any]] = BLOCK_OF_1, agents: int = 3, **keys: Any
) -> Simulated:
    events = {"source": "scripted", "script": script}
    one = scenario(agents=agents, duration_s=60, events=events, fates=fates, **keys)
    return simulate(one, 1, tracing=True, deliver_all=True)


def arrivals(simulated: Simulated, agent_id: int, message: str) -> list[tuple[float, int]]:
    """Return the mission second and the sender of each message of this type that reached the agent."""
    runs = simulated.evidence.traces[agent_id].runs
    return [
        (run.t, run.trigger.sender)
        for run in runs
        if isinstance(run.trigger, MessageTrigger) and run.trigger.message == message
    ]


def branches(simulated: Simulated, agent_id: int, handler: str) -> list[str]:
    return [run.branch for run in simulated.evidence.traces[agent_id].runs if run.handler == handler]


def test_fate_drops_one_commit_for_one_receiver() -> None:
    """Agent 2 misses the commit of agent 4's last block, and no agent detects the missing block (Figure 4.2)."""
    simulated = simulate(load_scenario(SCENARIOS / "lost_last_commit.yaml"), 1, tracing=True)
    chains = {agent_id: len(export.chain) for agent_id, export in simulated.evidence.exports.items()}
    assert chains == {1: 4, 2: 3, 3: 4, 4: 4, 5: 4}
    assert not simulated.played.unmatched_fates
    assert simulated.result.characteristics["6"].verdict == "not applicable"


def test_fates_force_a_tie_that_the_oldest_timestamp_decides() -> None:
    simulated = simulate(load_scenario(SCENARIOS / "forced_tie.yaml"), 1, tracing=True)
    assert branches(simulated, 1, "reconcile_phase_2_timer_expiration")[0] == "tie: top of chain"
    assert {one.verdict for one in simulated.result.characteristics.values()} == {"holds"}


def test_checker_finds_the_crash_on_a_tie_of_the_field_test() -> None:
    one = load_scenario(SCENARIOS / "forced_tie.yaml")
    one = one.model_validate({**one.model_dump(), "quirks": {"crash_on_tie": True}})
    simulated = simulate(one, 1, tracing=True)
    distributed = simulated.result.characteristics["1"]
    assert distributed.verdict == "violated"
    assert "a reconcile did not continue" in distributed.evidence[0].detail
    assert (distributed.evidence[0].agent_id, simulated.played.settled) == (1, False)


def test_fates_make_chains_diverge_by_50_blocks() -> None:
    simulated = simulate(load_scenario(SCENARIOS / "large_divergence.yaml"), 1, tracing=True)
    stacks = [run.state.stack for trace in simulated.evidence.traces.values() for run in trace.runs]
    assert max(stacks) >= 50
    assert {one.verdict for one in simulated.result.characteristics.values()} == {"holds"}


def test_fate_selects_by_type_sender_receiver_and_count() -> None:
    drop = {"message": "Block Add Response", "sender": 2, "receiver": 1, "count": 1, "drop": True}
    script = [*BLOCK_OF_1, *({"at_s": at_s, "agent": 1} for at_s in (21, 22, 23))]
    heard = arrivals(played([drop], script), 1, "Block Add Response")
    assert [sender for t, sender in heard if t < 20] == [3]
    assert sorted(sender for t, sender in heard if t > 20) == [2, 3]


def test_block_ordinal_counts_across_a_reboot() -> None:
    script = [*BLOCK_OF_1, *({"at_s": at_s, "agent": 1} for at_s in (30, 31, 32))]
    reboot = [{"at_s": 20, "reboot": [1], "down_s": 5, "disk": "kept"}]
    missed = [{"message": "Commit Block", "block": "1.2", "receiver": 2, "drop": True}]
    simulated = played(missed, script, timeline=reboot)
    assert not simulated.played.unmatched_fates
    assert [len(export.chain) for export in simulated.evidence.exports.values()] == [2, 1, 2]


def test_fate_selects_by_block_and_sending_time() -> None:
    script = [*BLOCK_OF_1, *({"at_s": at_s, "agent": 1} for at_s in (21, 22, 23))]
    by_block = arrivals(played([{"block": "1.2", "sender": 1, "drop": True}], script), 2, "Block Add Request")
    by_time = arrivals(played([{"from_s": 20, "until_s": 30, "drop": True}], script), 2, "Block Add Request")
    assert len(by_block) == len(by_time) == 1
    early = played([{"message": "Block Add Request", "until_s": 3, "drop": True}])  # the request is sent at 3
    assert len(arrivals(early, 2, "Block Add Request")) == 1


def test_fate_delays_a_message_or_holds_all_messages_of_an_agent() -> None:
    delayed = played([{"message": "Block Add Request", "receiver": 2, "delay_s": 4}])
    assert arrivals(delayed, 2, "Block Add Request") == [(7.0, 1)]
    held = played([{"sender": 1, "hold_until_s": 30}])
    assert arrivals(held, 2, "Block Add Request") == [(30.0, 1)]
    assert arrivals(held, 2, "Commit Block") == [(30.0, 1)]
    assert len(held.evidence.exports[2].chain) == 1
    ((at_s, _),) = arrivals(played([{"message": "Block Add Request", "hold_until_s": 1}]), 2, "Block Add Request")
    assert 3.002 <= at_s <= 3.05


def test_fates_deliver_two_responses_in_either_order() -> None:
    for first, second in ((2, 3), (3, 2)):
        fates = [
            {"message": "Block Add Response", "sender": first, "receiver": 1, "name": "first"},
            {"message": "Block Add Response", "sender": second, "receiver": 1, "after": "first"},
        ]
        heard = [sender for _, sender in arrivals(played(fates), 1, "Block Add Response")]
        assert heard == [first, second]


def test_first_matching_fate_decides_and_the_network_decides_the_rest() -> None:
    fates = [
        {"message": "Commit Block", "receiver": 2, "delay_s": 1},
        {"message": "Commit Block", "drop": True},
    ]
    simulated = played(fates)
    assert arrivals(simulated, 2, "Commit Block") == [(14.0, 1)]
    assert arrivals(simulated, 3, "Commit Block") == []
    everything_lost = played([{"message": "Commit Block", "delay_s": 1}], network={"loss": 1.0})
    assert arrivals(everything_lost, 2, "Commit Block") == [(14.0, 1)]
    assert arrivals(everything_lost, 2, "Block Add Request") == []


def test_fate_does_not_cross_a_partition() -> None:
    cut = [{"at_s": 0, "partition": [[1, 3], [2]]}]
    simulated = played([{"message": "Commit Block", "delay_s": 1}], timeline=cut)
    assert arrivals(simulated, 2, "Commit Block") == []
    assert arrivals(simulated, 3, "Commit Block") == [(14.0, 1)]


def test_unmatched_fate_is_reported_and_the_run_has_status_2(tmp_path: Path) -> None:
    fates = [
        {"message": "Commit Block", "block": "3.7", "receiver": 2, "drop": True},
        {"message": "Block Response", "name": "never"},
        {"message": "Commit Block", "after": "never"},
    ]
    one = scenario(agents=3, duration_s=60, events={"source": "scripted", "script": BLOCK_OF_1}, fates=fates)
    finished = run(one, 1, tmp_path / "run", SilentProgress(), "sim")
    assert finished.exit_status == WRONG_REQUEST
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["unmatched_fates"] == [
        "fates.0 (drop Commit Block of block 3.7 to 2) matched no message",
        "fates.1 (name 'never' Block Response) matched no message",
        "fates.2 (deliver after 'never' Commit Block): the message that 'never' is about never arrived",
    ]


@pytest.mark.parametrize(
    ("fate", "sentence"),
    [
        ({"message": "Commit Block"}, "needs exactly one of `drop: true`, `delay_s`"),
        ({"drop": True, "delay_s": 1}, "needs exactly one of"),
        ({"message": "Commit", "drop": True}, "'Block Add Request', 'Block Add Response'"),
        ({"block": 4.1, "drop": True}, "should be quoted, as in"),
        ({"block": "4", "drop": True}, "the number of its block"),
        ({"sender": 9, "drop": True}, "fates.0.sender names vehicle 9, which is not on the roster: use one of 1, 2, 3"),
        ({"block": "9.1", "drop": True}, "fates.0.block names vehicle 9"),
        ({"after": "x"}, "fates.0.after 'x' is not the name of a fate"),
        ({"from_s": 5, "until_s": 5, "drop": True}, "from_s 5 is not before until_s 5"),
        ({"count": 0, "drop": True}, "greater than or equal to 1"),
    ],
)
def test_invalid_fate_is_refused(fate: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        scenario(agents=3, fates=[fate])
