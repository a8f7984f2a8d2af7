"""Test packet capture files: both formats, both byte orders, truncated files and hostile files."""

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.archive.packets.capture_reader import Capture, Datagram, NotUcpError, unwrap
from harness.archive.packets.pcap import INBOUND, OUTBOUND, CaptureFile, Frame
from harness.errors import CaptureError
from tests.harness.captures import PcapNg, frame, pcap
from ucp.messages import ChainContainQuery, encode

QUERY = encode(7, 1, ChainContainQuery(bytes(32)))
ETHERNET = 1


def three_packets(order: str = "<", resolution: int = 9) -> PcapNg:
    file = PcapNg(7, order, resolution)
    file.packet(1_000, OUTBOUND, frame(7, QUERY))
    file.packet(2_000, INBOUND, b"odd")
    file.packet(2**33, 0, b"")
    file.statistics(2**33, dropped=1)
    file.statistics(2**34, dropped=3)  # The last statistics count. They include the earlier ones.
    return file


def payload(data: bytes, link_type: int = ETHERNET) -> bytes:
    return unwrap(Frame(0, 0, link_type, data, len(data)))[0]


def reason(data: bytes, link_type: int = ETHERNET, length: int | None = None) -> str:
    with pytest.raises(NotUcpError) as refused:
        unwrap(Frame(0, 0, link_type, data, len(data) if length is None else length))
    return refused.value.reason


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("resolution", "units_per_s"), [(9, 10**9), (6, 10**6), (0x80 | 10, 2**10)])
def test_reader_accepts_pcapng_of_any_byte_order_and_resolution(
    tmp_path: Path, order: str, resolution: int, units_per_s: int
) -> None:
    path = tmp_path / "file"
    path.write_bytes(three_packets(order, resolution).data)
    file = CaptureFile(path)
    assert [(one.time_ns, one.direction, one.data) for one in file] == [
        (1_000 * 10**9 // units_per_s, OUTBOUND, frame(7, QUERY)),
        (2_000 * 10**9 // units_per_s, INBOUND, b"odd"),
        (2**33 * 10**9 // units_per_s, 0, b""),
    ]
    assert (file.ended_ns, file.dropped, file.problem) == (2**34 * 10**9 // units_per_s, 3, "")


@pytest.mark.parametrize(("swap", "nanoseconds"), [(False, False), (True, False), (False, True), (True, True)])
def test_reader_accepts_the_four_forms_of_pcap(tmp_path: Path, swap: bool, nanoseconds: bool) -> None:
    order, magic = ">" if swap else "<", 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    path = tmp_path / "file"
    path.write_bytes(
        struct.pack(order + "I2H2i2I", magic, 2, 4, 0, 0, 65535, 113) + struct.pack(order + "4I", 5, 6, 3, 90) + b"odd"
    )
    assert list(CaptureFile(path)) == [Frame(5 * 10**9 + (6 if nanoseconds else 6000), 0, 113, b"odd", 90)]


def test_reader_yields_frames_before_any_truncation(tmp_path: Path) -> None:
    whole = three_packets().data
    path = tmp_path / "file"
    read = []
    for length in range(4, len(whole)):
        path.write_bytes(whole[:length])
        file = CaptureFile(path)
        read.append(len(list(file)))
        at_a_block_s_end = not file.problem
        assert at_a_block_s_end or file.problem.startswith("ends within the block that starts at byte ")
    assert read == sorted(read)
    assert set(read) == {0, 1, 2, 3}


@given(st.data())
def test_reader_survives_any_content(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    whole = data.draw(st.sampled_from([three_packets().data, three_packets(">").data, pcap([(1, frame(7, QUERY))])]))
    damaged = bytearray(whole)
    for position, value in data.draw(st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255)))):
        damaged[position] = value
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(bytes(damaged) + data.draw(st.binary()))
    datagrams: dict[bytes, Datagram] = {}
    try:
        capture = Capture(0, path)
        capture.read(datagrams)
    except CaptureError as error:
        assert "not a pcapng or pcap file" in str(error)
    else:
        assert capture.frames <= 4


def test_reader_limits_the_block_length(tmp_path: Path) -> None:
    path = tmp_path / "file"
    good = three_packets().data
    for bad in struct.pack("<2I", 6, 0xFFFFFFF0), struct.pack("<2I", 77, 8), struct.pack("<3I", 77, 12, 16):
        path.write_bytes(good + bad)
        file = CaptureFile(path)
        assert len(list(file)) == 3
        assert file.problem == f"is damaged at byte {len(good)}; the part before is read"


def test_unwrap_accepts_each_link_type_of_tcpdump() -> None:
    ethernet = frame(7, QUERY)
    packet = ethernet[14:]
    assert payload(ethernet) == QUERY
    assert payload(ethernet + bytes(9)) == QUERY  # padded
    assert payload(ethernet[:12] + b"\x81\x00\x00\x05" + ethernet[12:]) == QUERY  # VLAN 5
    assert payload(packet, 101) == QUERY
    cooked = b"\x00\x04" + bytes(12) + b"\x08\x00" + packet
    assert unwrap(Frame(0, 0, 113, cooked, len(cooked))) == (QUERY, OUTBOUND)
    cooked_2 = b"\x08\x00" + bytes(8) + b"\x04" + bytes(9) + packet
    assert unwrap(Frame(0, 0, 276, cooked_2, len(cooked_2))) == (QUERY, OUTBOUND)


def test_frame_without_ucp_datagram_has_a_reason() -> None:
    ethernet = frame(7, QUERY)
    assert reason(ethernet[:12] + b"\x08\x06" + bytes(28)) == "ARP"
    assert reason(ethernet[:12] + b"\x86\xdd" + bytes(40)) == "IPv6"
    assert reason(frame(7, b"another protocol", port=53)) == "UDP to other ports"
    assert reason(ethernet[:50], length=len(ethernet)) == "cut short by the capture"
    assert reason(ethernet, link_type=127) == "of another kind of link"
    assert reason(b"") == "neither IPv4 nor IPv6"


def test_unwrap_accepts_ucp_on_another_port() -> None:
    assert payload(frame(7, QUERY, port=15000)) == QUERY


def test_unwrap_detects_every_flipped_bit() -> None:
    """Flip each bit of a frame in turn. The Linux kernel of a receiver also drops such a frame."""
    ethernet = frame(7, QUERY)
    for bit in range(8 * 14, 8 * len(ethernet)):
        flipped = bytearray(ethernet)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(NotUcpError):
            unwrap(Frame(0, 0, ETHERNET, bytes(flipped), len(flipped)))


def test_unwrap_accepts_an_offloaded_checksum() -> None:
    ethernet = bytearray(frame(7, QUERY))
    addresses = ethernet[26:34]
    total = sum(struct.unpack("!4H", addresses)) + 17 + len(QUERY) + 8
    ethernet[40:42] = struct.pack("!H", (total & 0xFFFF) + (total >> 16))
    assert payload(bytes(ethernet)) == QUERY
    ethernet[40:42] = bytes(2)
    assert payload(bytes(ethernet)) == QUERY


def test_capture_belongs_to_a_vehicle_by_comment_sender_or_name(tmp_path: Path) -> None:
    def vehicle(name: str, data: bytes) -> int | None:
        path = tmp_path / name
        path.write_bytes(data)
        capture = Capture(0, path)
        capture.read({})
        return capture.vehicle

    foreign = PcapNg()
    foreign.packet(1, OUTBOUND, frame(7, QUERY))
    assert vehicle("range.pcapng", three_packets().data) == 7  # from its comment
    assert vehicle("3.pcapng", foreign.data) == 7  # from the sender of its outbound datagrams
    assert vehicle("3.pcap", pcap([(1, frame(7, QUERY))])) == 3  # from its file name
    assert vehicle("range.pcap", pcap([(1, frame(7, QUERY))])) is None
    assert vehicle("99999999999999999999.pcap", pcap([])) is None
