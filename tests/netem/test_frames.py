"""Compare Ethernet frames with the frames that scapy creates."""

from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether

from netem import addresses
from netem.frames import udp_broadcast


@given(vehicle=st.integers(addresses.MIN_ID, addresses.MAX_ID), data=st.binary(max_size=1472))
def test_broadcast_frame_has_correct_headers_and_checksums(vehicle: int, data: bytes) -> None:
    own, everyone = addresses.address(vehicle), addresses.BROADCAST
    wanted = (
        Ether(dst="ff:ff:ff:ff:ff:ff", src=addresses.mac(vehicle))
        / IP(src=own, dst=everyone, id=0, flags="DF")
        / UDP(sport=14600, dport=14600)
        / data
    )
    assert udp_broadcast(vehicle, 14600, data) == bytes(wanted)


def test_checksum_0_becomes_all_ones_only_in_udp() -> None:
    """A UDP checksum of 0 means that there is no checksum (RFC 768)."""
    udp = {udp_broadcast(1, 14600, word.to_bytes(2, "big"))[40:42] for word in range(0x10000)}
    ip = {udp_broadcast(vehicle, 14600, b"")[24:26] for vehicle in range(1, 0x10000)}
    assert b"\xff\xff" in udp - ip
    assert b"\0\0" in ip - udp
