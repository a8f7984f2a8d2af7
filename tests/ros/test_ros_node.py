"""Test that an agent can be a ROS 2 node, as the documentation describes. `make test-ros` provides ROS."""

from pathlib import Path

import pytest
from scapy.layers.inet import UDP
from scapy.layers.l2 import ARP
from scapy.utils import PcapNgReader

from harness.archive.archive import RunArchive
from tests.machine import do_without
from tests.pages import REPOSITORY, play
from ucp.messages import PORT

pytestmark = [pytest.mark.lab, pytest.mark.ros]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory in which the steps of the documentation page were done."""
    if not (REPOSITORY / ".ros" / "installed").exists():
        do_without("ros", "there is no ROS 2 in .ros: make test-ros installs it")
    directory = tmp_path_factory.mktemp("a clone")
    for name in (".ros", "ucp"):
        (directory / name).symlink_to(REPOSITORY / name)
    assert play(REPOSITORY / "docs/how-to/run-a-ros-node.md", directory) == 5
    return directory


def test_ros_agent_follows_the_algorithms_with_loss_and_a_partition(played: Path) -> None:
    record = RunArchive(played / "mixed").record
    assert {key: judgement.verdict for key, judgement in record.judgements.items()} == {
        **dict.fromkeys("123456", "holds"),
        **{"steps": "as specified", "records": "agree", "liveness": "finished"},
    }
    assert record.agents["2"].version == "rclpy on rmw_fastrtps_cpp"
    assert record.figures["blocks"]
    partition = next(change for change in record.network if change.what == "partition")
    assert "1 2 | 3" in partition.detail


def test_captures_contain_no_datagram_of_ros(played: Path) -> None:
    captures = sorted((played / "mixed" / "capture").glob("*.pcapng"))
    assert len(captures) == 3
    for capture in captures:
        with PcapNgReader(str(capture)) as frames:
            others = [frame for frame in frames if ARP not in frame and (UDP not in frame or frame[UDP].dport != PORT)]
        assert not others, [frame.summary() for frame in others[:5]]
