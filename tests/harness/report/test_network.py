"""Test the picture of the recorded network over mission time."""

import json
import re
from pathlib import Path
from typing import Any

from harness.archive.connectivity import read_connectivity
from harness.archive.run_record import RunRecord
from harness.report._network_section import event_rows, ground_station, strip


def drawn(path: Path, *lines: dict[str, Any]) -> list[str]:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    lanes = strip(read_connectivity(path, (1, 2, 3)), [], 600.0)
    assert lanes is not None
    return re.findall(r"<title>([^<]*: .*?)</title>", lanes.picture.replace("\u00a0", " "))


def asked(at_s: float, loss: float, *groups: list[int]) -> dict[str, Any]:
    conditions = {"default": {"loss": loss}, "receivers": {}, "links": {}, "partition": list(groups)}
    return {"at_s": at_s, "what": "network", "detail": "", "fully_connected": False, "asked": conditions}


def test_strip_shows_recorded_partitions_and_losses(tmp_path: Path) -> None:
    lines = (asked(0, 0.1), asked(60, 0.2), asked(120, 0.2, [1, 2], [3]), asked(180, 0.2, [1], [2], [3]), asked(240, 0))
    assert drawn(tmp_path / "network.jsonl", *lines) == [
        "partition: A 1, 2; alone 3, 120 s to 180 s",
        "partition: alone 1\u20133, 180 s to 240 s",
        "loss: 10 %, 0 s to 60 s",
        "loss: 20 %, 60 s to 180 s",
        "1\u20133, 2\u20133: 10 %, 0 s to 60 s",
        "1\u20133, 2\u20133: 20 %, 60 s to 120 s",
        "1\u20133, 2\u20133: no link, 120 s to 240 s",
        "1\u20132: 10 %, 0 s to 60 s",
        "1\u20132: 20 %, 60 s to 180 s",
        "1\u20132: no link, 180 s to 240 s",
    ]


def test_equal_pairs_have_no_lanes(tmp_path: Path) -> None:
    assert drawn(tmp_path / "network.jsonl", asked(0, 0.98)) == ["loss: 98 %, 0 s to 600 s"]


def test_distance_adds_loss_and_a_lost_range_is_a_partition(tmp_path: Path) -> None:
    def flown(at_s: float, **losses: float) -> dict[str, Any]:
        return {
            "at_s": at_s,
            "what": "range",
            "losses": {name.replace("_", "-")[1:]: loss for name, loss in losses.items()},
        }

    lines = (asked(0, 0.1), flown(100, _1_2=0.5), flown(200, _1_2=1.0, _1_3=1.0))
    assert drawn(tmp_path / "network.jsonl", *lines) == [
        "partition: A 2, 3; alone 1, 200 s to 600 s",
        "loss: 10 %, 0 s to 100 s",
        "loss: 25 %, the worst link 55 %, 100 s to 200 s",
        "loss: 10 %, 200 s to 600 s",
        "1\u20132: 10 %, 0 s to 100 s",
        "1\u20132: 55 %, 100 s to 200 s",
        "1\u20132: no link, 200 s to 600 s",
        "1\u20133: 10 %, 0 s to 200 s",
        "1\u20133: no link, 200 s to 600 s",
        "2\u20133: 10 %, 0 s to 600 s",
    ]


def test_without_a_record_there_is_no_strip(tmp_path: Path) -> None:
    assert strip(read_connectivity(tmp_path / "network.jsonl", (1, 2)), [], 600.0) is None


def test_faults_by_hand_are_listed_among_scheduled_faults() -> None:
    record = RunRecord.model_validate(
        {
            "faults": [
                {"at_s": 60, "what": "kill", "detail": "agent 2", "agents": [2], "by_hand": True},
                {"at_s": 300, "what": "heal", "detail": "loss 0 %", "fully_connected": True},
            ],
            "ground_station": {
                "address": "127.0.0.1:14550",
                "sent": 12345,
                "received": 9,
                "dropped": 2,
                "commands_left_out": 4,
                "commands": [
                    {
                        "at_s": 125.5,
                        "until_s": 130,
                        "times": 3,
                        "vehicles": [1, 3],
                        "message": "COMMAND_LONG",
                        "command": "MAV_CMD_DO_SET_MODE",
                        "values": {"param1": 1.0, "param2": 6.0, "param3": 0.0, "param4": None},
                    }
                ],
            },
        }
    )
    rows = [[cell.replace("\u00a0", " ") for cell in row] for row in event_rows(record)]
    assert rows == [
        ["60 s", "kill", "agent 2; caused by hand"],
        ["125.5 s", "operator", "vehicles 1 3: MAV_CMD_DO_SET_MODE; param1 1, param2 6; 3 times until 130 s"],
        ["300 s", "heal", "loss 0 %; fully connected: yes"],
        ["later", "operator", "4 more commands, which are not recorded"],
    ]
    rows_text = (
        "Ground station at 127.0.0.1:14550: 12\u202f345 datagrams were sent to it, 9 datagrams came from it, and 2 "
        "were dropped."
    )
    assert ground_station(record) == rows_text
    assert ground_station(RunRecord()) is None
