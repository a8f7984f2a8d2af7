"""Test packet capture files: scapy reads complete files, truncated files, and files of a full disk."""

import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from scapy.utils import rdpcap

from netem.capture import begin_file
from netem.pcapng import PcapngFile
from tests.captured import CapturedFrame, comment, frames, statistics
from tests.machine import require_tshark

EPOCH_US = 1_790_000_000_000_000
AT_NS = EPOCH_US * 1000 + 123_456_789
FRAMES = [CapturedFrame(AT_NS + number, number % 3 == 0, bytes([number]) * (14 + number)) for number in range(60)]


def written(folder: Path) -> Path:
    path = begin_file(folder, 7, EPOCH_US, 20)
    file = PcapngFile(path)
    for frame in FRAMES:
        file.packet(frame.at_ns, frame.data, outbound=frame.outbound)
    file.statistics(FRAMES[-1].at_ns, received=100, dropped=40)
    file.close()
    return path


def test_written_packets_are_read_again(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert frames(path) == FRAMES
    assert comment(path) == {"ucp_harness": 1, "vehicle": 7, "epoch_us": EPOCH_US, "speedup": 20.0}
    assert statistics(path) == {"received": 100, "dropped": 40}
    assert [bytes(packet) for packet in rdpcap(str(path))] == [frame.data for frame in FRAMES]


def test_truncated_file_has_every_complete_packet(tmp_path: Path) -> None:
    path = written(tmp_path)
    whole = path.read_bytes()
    lengths = []
    for cut in range(len(whole) - 200, len(whole)):
        path.write_bytes(whole[:cut])
        found = frames(path)
        assert found == FRAMES[: len(found)]
        lengths.append(len(found))
    assert lengths[-1] == len(FRAMES)
    assert lengths[0] < len(FRAMES)


@contextmanager
def full_after(limit: int) -> Iterator[None]:
    """Limit the size of the files that this process writes to `limit` bytes inside the context."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_leaves_a_file_with_complete_packets(tmp_path: Path) -> None:
    path = begin_file(tmp_path, 7, EPOCH_US, 20)
    file = PcapngFile(path)
    file.packet(FRAMES[0].at_ns, FRAMES[0].data, outbound=FRAMES[0].outbound)
    file.flush()
    with full_after(path.stat().st_size + 1000):
        for frame in FRAMES[1:]:
            file.packet(frame.at_ns, frame.data, outbound=frame.outbound)
        with pytest.raises(OSError, match="File too large") as raised:
            file.flush()
        file.close()
    assert raised.value.filename == str(path)
    assert frames(path) == FRAMES[:1]


def test_wireshark_reads_the_file(tmp_path: Path) -> None:
    fields = ["frame.time_epoch", "frame.packet_flags_direction", "frame.interface_name", "frame.len"]
    shown = [part for field in fields for part in ("-e", field)]
    argv = [require_tshark(), "-r", str(written(tmp_path)), "-T", "fields", *shown]
    said = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    assert [line.split("\t") for line in said.splitlines()] == [
        [
            f"{frame.at_ns // 10**9}.{frame.at_ns % 10**9:09}",
            "0x00000002" if frame.outbound else "0x00000001",
            "vehicle 7",
            str(len(frame.data)),
        ]
        for frame in FRAMES
    ]
