"""Test a radio channel that agent processes share in real time."""

import json
from pathlib import Path
from typing import Any

from harness.archive.run_record import ChannelRecord, RunRecord
from harness.run.simulate import simulate
from harness.scenario.load import parse, parse_yaml
from tests.harness.command import harness
from tests.machine import require

FIVE = """
name: Five
agents: 5
duration_s: 60
speedup: 10
capture: true
vehicles: {kind: embedded}
events: {source: random, mean_s: 4}
settle: {limit_s: 300}
network: {loss: 0.1, channel: {preset: wifi_1}}
timeline:
  - {at_s: 20, partition: [[1, 2]], for_s: 10}
  - {at_s: 35, kill: [3]}
  - {at_s: 45, restart: [3]}
"""

ANSWERS_OVERLAP = """
name: Answers overlap
agents: 6
duration_s: 120
speedup: 10
vehicles: {kind: embedded}
events: {source: random, mean_s: 10}
settle: {limit_s: 300}
network: {channel: {preset: lora_sf7, duty: 1.0, largest_bytes: 1472, processing_s: 2.0}}
"""


def play(scenario: str, folder: Path, backend: str = "process") -> tuple[RunRecord, list[dict[str, Any]]]:
    """Play the scenario. Return the content of run.json, and the lines of channel.jsonl."""
    require(None)
    file, run = folder / f"{backend}.yaml", folder / backend
    file.write_text(scenario)
    done = harness("run", file, "--backend", backend, "--seed", 1, "--out", run)
    record = RunRecord.model_validate_json((run / "run.json").read_text())
    assert record.outcome == "completed", done.stderr
    return record, [json.loads(line) for line in (run / "channel.jsonl").read_text().splitlines()]


def test_processes_share_a_channel_and_no_record_contradicts(tmp_path: Path) -> None:
    record, lines = play(FIVE, tmp_path)
    assert record.channel is not None
    assert record.channel.model["preset"] == "wifi_1"
    assert record.channel.frames == sum("dropped" not in line for line in lines) > 0
    assert "partition" in record.channel.lost
    assert record.channel.lateness is not None
    assert record.channel.lateness.deliveries > 0
    assert record.channel.lateness.missed == record.channel.lateness.unsent == 0
    assert record.records is not None
    assert record.records.verdict == "agree", record.records
    assert all(line["at_s"] <= line["began_s"] < line["ended_s"] for line in lines if "dropped" not in line)


def shares(channels: list[ChannelRecord], receivers: int) -> dict[str, float]:
    """Return the share of copies that these radio channels lost, for each reason."""
    copies = receivers * sum(channel.frames for channel in channels)
    return {
        reason: sum(channel.total(reason) for channel in channels) / copies for reason in ("collision", "half_duplex")
    }


def test_processes_lose_the_same_shares_as_virtual_time(tmp_path: Path) -> None:
    record, _ = play(ANSWERS_OVERLAP, tmp_path)
    assert record.channel is not None
    scenario = parse(parse_yaml(ANSWERS_OVERLAP))
    virtual = [simulate(scenario, seed).played.channel for seed in range(6)]
    live, expected = shares([record.channel], 5), shares([each for each in virtual if each is not None], 5)
    assert expected["collision"] > 0.15
    for reason, share in expected.items():
        assert abs(live[reason] - share) < 0.12, (live, expected)
