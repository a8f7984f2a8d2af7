"""Test a radio channel that all vehicles share in virtual time."""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.archive.packets.packets_document import PacketsRecord
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario
from tests.harness.command import harness

DISTURBED = [
    {"at_s": 100, "partition": [[1, 2]], "for_s": 50},
    {"at_s": 200, "pause": [3]},
    {"at_s": 215, "resume": [3]},
    {"at_s": 217, "kill": [2]},
    {"at_s": 230, "restart": [2]},
]


def scenario(preset: str = "wifi_1", agents: int = 5, **keys: Any) -> Scenario:
    network = {"channel": {"preset": preset, **keys.pop("channel", {})}, **keys.pop("network", {})}
    document = {"name": "Channel", "agents": agents, "duration_s": 300, "settle": {"limit_s": 300}}
    return Scenario.model_validate({**document, "network": network, **keys})


def outcome(simulated: Simulated) -> str:
    played = simulated.played
    agents = {agent_id: agent.model_dump(exclude={"handler_runs"}) for agent_id, agent in played.agents.items()}
    network = [state.model_dump() for state in played.network]
    return json.dumps([agents, network, played.mission_s, played.channel and played.channel.model_dump()])


@pytest.mark.parametrize(
    ("preset", "network"),
    [
        ("wifi_1", {"loss": 0.1}),
        ("wifi_6", {"delay": {"mean_s": 0.05, "jitter_s": 0.05}, "duplicate": 0.2, "reorder": 0.1}),
        ("rfd900", {}),
        ("lora_sf7", {}),
    ],
)
@pytest.mark.parametrize("timeline", [[], DISTURBED])
def test_run_is_the_same_whether_or_not_all_messages_are_delivered(
    preset: str, network: dict[str, Any], timeline: list[dict[str, Any]]
) -> None:
    played = scenario(preset, network=network, timeline=timeline)
    plain = simulate(played, 1)
    assert outcome(plain) == outcome(simulate(played, 1))
    assert outcome(plain) == outcome(simulate(played, 1, tracing=True))
    assert outcome(plain) == outcome(simulate(played, 1, tracing=True, deliver_all=True))


def test_answers_that_begin_at_once_collide() -> None:
    def collisions(processing_s: float) -> int:
        played = scenario("wifi_1", 20, channel={"processing_s": processing_s}, duration_s=60)
        return int(simulate(played, 1).result.figures["collisions"] or 0)

    assert collisions(0.0) > 2 * collisions(0.2)


def test_partition_separates_the_channels() -> None:
    apart = simulate(scenario(network={"loss": 0.0}, timeline=[{"at_s": 0.1, "partition": [[1, 2]]}]), 1)
    assert apart.played.channel is not None
    assert apart.played.channel.lost["partition"]["1"] > 0
    assert apart.result.figures["distinct_chains"] == 2


def test_channel_is_never_fully_connected() -> None:
    states = simulate(scenario(), 1).played.network
    assert [state.fully_connected for state in states] == [False]
    assert states[0].detail == "loss 0 %, shared channel wifi_1"


def test_final_reconcile_has_no_channel() -> None:
    played = scenario("lora_sf7", final_reconcile=True)
    simulated = simulate(played, 1)
    assert simulated.played.final_reconcile is not None
    assert simulated.played.final_reconcile.complete
    assert simulated.result.figures["distinct_chains"] == 1


def test_scripted_fate_drops_a_frame_that_the_channel_delivers() -> None:
    dropped = simulate(scenario(fates=[{"message": "Commit Block", "receiver": 5, "drop": True}]), 1)
    assert dropped.played.unmatched_fates == []
    assert dropped.result.figures["reconciles"] != 0
    assert simulate(scenario(), 1).result.figures["reconciles"] == 0


def test_record_has_the_load_and_every_loss() -> None:
    channel = simulate(scenario("wifi_1", 20, channel={"processing_s": 0.0}, duration_s=100), 1).played.channel
    assert channel is not None
    assert channel.model["preset"] == "wifi_1"
    assert channel.model["rate_bps"] == 1e6
    assert channel.frames > 0
    assert channel.airtime_s >= sum(channel.load) * channel.load_interval_s - 1e-3
    assert max(channel.load) <= 1
    assert sum(channel.lost["collision"].values()) > 0
    assert sum(channel.lost["half_duplex"].values()) > 0


def test_run_without_a_channel_has_no_record_of_it() -> None:
    assert simulate(Scenario.model_validate({"name": "Ideal", "duration_s": 60}), 1).played.channel is None


CROWD = """
name: Crowd
agents: 12
duration_s: 120
capture: true
network: {channel: {preset: wifi_1, processing_s: 0, queue_frames: 1}}
"""


def test_packets_prints_the_reason_of_each_loss(tmp_path: Path) -> None:
    scenario, run = tmp_path / "crowd.yaml", tmp_path / "run"
    scenario.write_text(CROWD)
    assert harness("run", scenario, "--backend", "sim", "--seed", 1, "--out", run).returncode == 0
    lines = [json.loads(line) for line in (run / "channel.jsonl").read_text().splitlines()]
    collided = [line for line in lines if line.get("lost", {}).get("collision")]
    assert collided
    assert all(line["at_s"] <= line["began_s"] < line["ended_s"] for line in collided)
    printed = harness("packets", run, "--lost").stdout
    assert printed.count("(collision: ") + printed.count("half duplex: ") >= len(collided)

    document = json.loads(harness("packets", run, "--json").stdout)
    PacketsRecord.model_validate(document, extra="forbid")
    recorded = {(line["sender"], line["sequence"]): line for line in lines}
    for datagram in document["datagrams"]:
        line = recorded[datagram["sender"], datagram["sequence"]]
        expected = {line["dropped"]: datagram["lost_by"]} if "dropped" in line else line["lost"]
        assert datagram.get("loss_reasons", {}) == expected
    assert any("loss_reasons" not in datagram for datagram in document["datagrams"])
