"""Test `ucp-harness export --rosbag` by reading the bag with the package rosbags and with `import`."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from harness.archive.archive import RunArchive
from tests.harness.command import harness

Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def bag(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("rosbag") / "bag"
    exported = harness("export", run, "--rosbag", bag)
    assert (exported.returncode, exported.stderr) == (0, "")
    return bag


@pytest.fixture(scope="module")
def messages(bag: Path) -> Messages:
    store = get_typestore(Stores.ROS2_HUMBLE)
    by_topic: Messages = defaultdict(list)
    with Reader(bag) as reader:
        for connection, at_ns, data in reader.messages():
            by_topic[connection.topic].append((at_ns, store.deserialize_cdr(data, connection.msgtype)))
    return by_topic


def test_import_restores_the_run_from_the_bag(run: Path, bag: Path, tmp_path: Path) -> None:
    imported = harness("import", bag, "--out", tmp_path / "again")
    assert imported.returncode == 0, imported.stderr
    for agent in (1, 2, 3):
        trace = f"agents/{agent}.trace.jsonl"
        assert (tmp_path / "again" / trace).read_bytes() == (run / trace).read_bytes()
    assert RunArchive(tmp_path / "again").exports.by_agent == RunArchive(run).exports.by_agent


def test_bag_has_the_positions_of_vehicles_and_links(run: Path, messages: Messages) -> None:
    last = RunArchive(run).tracks([1, 2, 3]).by_vehicle[1][-1]
    at_ns, fix = messages["/vehicle_1/fix"][-1]
    assert at_ns == round(last.at_s * 1e9) == fix.header.stamp.sec * 10**9 + fix.header.stamp.nanosec
    assert -90 <= fix.latitude <= 90 and fix.header.frame_id == "vehicle_1"
    move = [message.transforms[0] for at, message in messages["/tf"] if at == at_ns]
    assert (last.east_m, last.north_m) in [
        (message.transform.translation.x, message.transform.translation.y) for message in move
    ]
    ends = {at // 10**9: len(message.markers[0].points) for at, message in messages["/links"]}
    assert (ends[45], ends[75]) == (6, 2)


def test_chains_and_losses_can_be_plotted_and_the_log_is_rosout(run: Path, messages: Messages) -> None:
    assert messages["/agent_3/chain"][-1][1].data == len(RunArchive(run).exports.by_agent[3].chain)
    assert {round(message.data, 1) for _, message in messages["/network/mean_loss"]} >= {0.1}
    assert any(message.name == "faults" and "reboot" in message.msg for _, message in messages["/rosout"])
    assert len(messages["/vehicle_1/mavlink"]) == 60
