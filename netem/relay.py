"""Take broadcasts out of the virtual switch before their delivery, and deliver them one by one.

    relay = Relay([1, 2, 3])                  in the lab's own network
    relay.open()                              the switch no longer floods broadcasts to these vehicles
    for heard in relay.take(): ...            each broadcast of a vehicle, with the time at which the kernel received it
    relay.deliver(2, heard.frame)

`python -m netem.relay 1 2 3` opens and closes a relay, to test whether the kernel supports it.

A simulated radio channel decides when each vehicle receives a broadcast, and which vehicles lose it. A queue of the
kernel at one port cannot do this. The relay uses two features that every bridge has. A port flag (`bcast_flood`,
bridge(8)) keeps broadcasts away from the vehicles. A packet socket (packet(7)) receives each broadcast before the
bridge handles it. Other packet sockets send the broadcast to single ports.

The vehicles detect no difference, and the switch handles all other packets as before. A capture at a port contains the
frames that the vehicle sent, and the frames that the relay delivered to the vehicle. Frames keep the header of
`PACKET_VNET_HDR`. This header marks the checksum of a frame as missing, so that the kernel need not compute it.
Delivered frames have a packet mark, and every engine lets frames with this mark pass.
"""

from __future__ import annotations

import contextlib
import mmap
import socket
import struct
import sys
import time
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from netem import addresses
from netem._fabric import BRIDGE
from netem._fabric_requests import flood_broadcasts
from netem._netlink import NetlinkSocket
from netem._tc_requests import RELAYED
from netem.errors import NetlinkError

# linux/if_packet.h, linux/filter.h, asm-generic/socket.h
_SOL_PACKET = 263
_RX_RING, _STATISTICS, _VERSION, _VNET_HDR = 5, 6, 10, 15
_TPACKET_V2 = 1
_ETH_P_ALL = 3
_SO_ATTACH_FILTER, _SO_MARK = 26, 36
_PKTTYPE, _IFINDEX = 0xFFFFF004, 0xFFFFF008  # SKF_AD_OFF + SKF_AD_PKTTYPE, SKF_AD_OFF + SKF_AD_IFINDEX
_LOAD, _JUMP_EQUAL, _RETURN = 0x20, 0x15, 0x06  # BPF_LD | BPF_W | BPF_ABS, BPF_JMP | BPF_JEQ | BPF_K, BPF_RET | BPF_K
_BROADCAST = 1  # value of sll_pkttype
_KERNEL_S, _OURS = 0, 1  # owner of a slot

_REQUEST = struct.Struct("=4I")
_SLOT = struct.Struct("=IIIHHII8xHHi")  # tpacket2_hdr, and the begin of the sockaddr_ll behind it
_COUNTS = struct.Struct("=II")
_VNET_BYTES = 10
_SLOT_BYTES = 2048
_BLOCK_BYTES = 1 << 17
_SLOTS = 4096

_ETHERNET_BYTES = 14
_IPV4 = b"\x08\x00"
_IP_MIN_BYTES = 20
_UDP_BYTES = 8
_NOT_THE_WHOLE = 0x3FFF  # flag "more fragments", and offset of a fragment


@dataclass(frozen=True, slots=True)
class ReceivedBroadcast:
    """A broadcast of a vehicle. `at_ns` is the time at which the kernel received it, on Python's monotonic clock."""

    vehicle: int
    at_ns: int
    frame: bytes
    """The Ethernet frame, after a `virtio_net_hdr` that the kernel puts before it."""

    def udp_data(self, port: int) -> bytes | None:
        """Return the data of an unfragmented IPv4 UDP datagram to this port. Return None for any other frame."""
        at = _VNET_BYTES + _ETHERNET_BYTES
        frame = self.frame
        if frame[at - 2 : at] != _IPV4 or len(frame) < at + _IP_MIN_BYTES:
            return None
        whole = int.from_bytes(frame[at + 6 : at + 8], "big") & _NOT_THE_WHOLE == 0
        udp = at + 4 * (frame[at] & 0xF)
        if not whole or frame[at + 9] != socket.IPPROTO_UDP or len(frame) < udp + _UDP_BYTES:
            return None
        if int.from_bytes(frame[udp + 2 : udp + 4], "big") != port:
            return None
        length = int.from_bytes(frame[udp + 4 : udp + 6], "big")
        return frame[udp + _UDP_BYTES : udp + length]


class Relay:
    """A relay for the broadcasts to the vehicles in `vehicles`. From `open` to `close`, the switch does not deliver
    broadcasts to these vehicles. Raises OSError if packet sockets are not available.

    `others` are further vehicles of the lab. The relay also reads the broadcasts that they send, but the switch still
    delivers all broadcasts to them.
    """

    def __init__(self, vehicles: Sequence[int], others: Sequence[int] = ()) -> None:
        self.missed = 0
        """Number of broadcasts that did not fit into the buffer, as of the last call of `count_missed`."""
        self._ports = {socket.if_nametoindex(addresses.port(vehicle)): vehicle for vehicle in (*vehicles, *others)}
        self._next = 0
        self._input = _socket(_ETH_P_ALL)
        self._input.setsockopt(_SOL_PACKET, _VERSION, _TPACKET_V2)
        size = _SLOTS * _SLOT_BYTES
        self._input.setsockopt(
            _SOL_PACKET, _RX_RING, _REQUEST.pack(_BLOCK_BYTES, size // _BLOCK_BYTES, _SLOT_BYTES, _SLOTS)
        )
        self._slots = mmap.mmap(self._input.fileno(), size)
        _attach_filter(self._input, socket.if_nametoindex(BRIDGE))
        self._outputs: dict[int, socket.socket] = {}
        for vehicle in vehicles:
            output = self._outputs[vehicle] = _socket(0)
            output.setsockopt(socket.SOL_SOCKET, _SO_MARK, RELAYED)
            output.bind((addresses.port(vehicle), 0))

    @property
    def input(self) -> socket.socket:
        """A socket that is readable when `take` can return broadcasts."""
        return self._input

    def open(self) -> None:
        """Stop the switch from delivering broadcasts to the vehicles. Raises NetlinkError if the kernel refuses."""
        for _ in self.take():
            pass  # the switch has flooded these
        self._flood(False)

    def close(self) -> None:
        """Let the switch deliver broadcasts as before `open`."""
        self._flood(True)
        self._input.close()

    def _flood(self, on: bool) -> None:
        ports = [(addresses.port(vehicle), index) for index, vehicle in self._ports.items() if vehicle in self._outputs]
        with contextlib.closing(NetlinkSocket()) as netlink:
            netlink.send([flood_broadcasts(port, index, on) for port, index in ports])

    def take(self) -> Iterator[ReceivedBroadcast]:
        """Yield the waiting broadcasts, in the order in which the kernel received them."""
        slots = self._slots
        offset_ns = time.time_ns() - time.monotonic_ns()
        while True:
            at = self._next * _SLOT_BYTES
            status, _, size, mac, _, seconds, ns, _, _, index = _SLOT.unpack_from(slots, at)
            if not status & _OURS:
                return
            frame = slots[at + mac - _VNET_BYTES : at + mac + size]
            struct.pack_into("=I", slots, at, _KERNEL_S)
            self._next = (self._next + 1) % _SLOTS
            vehicle = self._ports.get(index)
            if vehicle is not None:
                yield ReceivedBroadcast(vehicle, seconds * 1_000_000_000 + ns - offset_ns, frame)

    def deliver(self, vehicle: int, frame: bytes) -> None:
        """Deliver a frame to a vehicle. Raises OSError if its port does not accept the frame."""
        self._outputs[vehicle].send(frame)

    def count_missed(self) -> int:
        """Update the number of broadcasts that did not fit into the buffer, and return it."""
        _, dropped = _COUNTS.unpack(self._input.getsockopt(_SOL_PACKET, _STATISTICS, _COUNTS.size))
        self.missed += dropped  # since the last call
        return self.missed


def _socket(protocol: int) -> socket.socket:
    """Return a packet socket that receives frames of this Ethernet protocol. If the protocol is 0, the socket only
    sends.
    """
    packets = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(protocol))
    packets.setsockopt(_SOL_PACKET, _VNET_HDR, 1)
    return packets


def _attach_filter(packets: socket.socket, bridge: int) -> None:
    """Let the socket accept only broadcasts that arrive at a port of the bridge."""
    program = (
        (_LOAD, 0, 0, _PKTTYPE),
        (_JUMP_EQUAL, 0, 3, _BROADCAST),
        (_LOAD, 0, 0, _IFINDEX),
        (_JUMP_EQUAL, 1, 0, bridge),
        (_RETURN, 0, 0, 0xFFFFFFFF),
        (_RETURN, 0, 0, 0),
    )
    instructions = array("Q", b"".join(struct.pack("=HBBI", *instruction) for instruction in program))
    address, _ = instructions.buffer_info()
    packets.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(instructions), address))


def main() -> None:
    try:
        relay = Relay([int(vehicle) for vehicle in sys.argv[1:]])
        relay.open()
        relay.close()
    except (OSError, NetlinkError) as error:
        sys.exit(f"the kernel does not pass broadcasts to the shared channel: {error}")


if __name__ == "__main__":
    main()
