"""All frames that cross one switch port, by AF_PACKET and a ring of memory that we share with the kernel (TPACKET_V3).

The kernel fills a ring's blocks, and hands over a block when it is full or 100 ms old; a reader that is late finds them
all, as long as there is room. The kernel counts what crosses the port and what it had no room for, so that nobody has
to trust a reader. See packet(7), and packet_mmap in the kernel's documentation.

What leaves the port has passed netem and nftables: it reaches the vehicle. What enters it has met neither. The kernel
leaves the checksums of what veth pairs carry for later, which never comes: it says where they are missing, and they
are put in here.
"""

from __future__ import annotations

import mmap
import socket
import struct
from array import array
from collections.abc import Iterator

from netem.frames import checksum

# linux/if_packet.h, linux/filter.h
_SOL_PACKET = 263
_RX_RING, _STATISTICS, _VERSION, _VNET_HDR = 5, 6, 10, 15
_TPACKET_V3 = 2
_ETH_P_ALL = 3
_SO_ATTACH_FILTER = 26
_OUTGOING = 4  # of sll_pkttype
_KERNEL_S, _OURS = 0, 1  # whose a block is
_CHECKSUM_MISSING, _VLAN = 1 << 3, 1 << 4  # of tp_status
_RETURN = 6  # BPF_RET | BPF_K

_REQUEST = struct.Struct("=7I")
_BLOCK = struct.Struct("=8xIII")  # status, number of frames, where the first is
_STATUS_AT = 8
_FRAME = struct.Struct("=IIIIIIH6xIH20xB")  # tpacket3_hdr, and of the sockaddr_ll behind it sll_pkttype
_CHECKSUM = struct.Struct("=6xHH")  # virtio_net_hdr: csum_start, csum_offset
_COUNTS = struct.Struct("=III")
_MACS = 12  # bytes of both addresses, before a VLAN tag

BLOCK_BYTES = 1 << 17  # more than any frame, also those that veth pairs carry before TCP has cut them up
_SLOT_BYTES = 2048  # means nothing to TPACKET_V3, but has to divide a block
RETIRE_MS = 100
"""Age at which a block is handed over, full or not: what is quiet fills a ring in as many blocks times this."""


class Ring:
    """The frames that cross the port, from now on, in `blocks` blocks of memory.

    Raises OSError if the kernel has no AF_PACKET, no such port, or not the memory.
    """

    def __init__(self, port: str, blocks: int) -> None:
        self.received = 0
        """Frames that have crossed the port, as of the last `count`."""
        self.taken = 0
        self._dropped = 0
        self._blocks = blocks
        self._next = 0
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # that protocol hears nothing yet
        self._socket.setsockopt(_SOL_PACKET, _VERSION, _TPACKET_V3)
        self._socket.setsockopt(_SOL_PACKET, _VNET_HDR, 1)
        size = blocks * BLOCK_BYTES
        request = _REQUEST.pack(BLOCK_BYTES, blocks, _SLOT_BYTES, size // _SLOT_BYTES, RETIRE_MS, 0, 0)
        self._socket.setsockopt(_SOL_PACKET, _RX_RING, request)
        self._memory = mmap.mmap(self._socket.fileno(), size)
        self._socket.bind((port, _ETH_P_ALL))

    def fileno(self) -> int:
        """Readable when a block is ours."""
        return self._socket.fileno()

    def take(self) -> Iterator[tuple[int, bytes, bool]]:
        """(ns since the Unix epoch, frame, whether it leaves the port) of what there is: at most one ring full."""
        memory = self._memory
        for _ in range(self._blocks):
            block = self._next * BLOCK_BYTES
            status, frames, first = _BLOCK.unpack_from(memory, block)
            if not status & _OURS:
                return
            at = block + first
            for _ in range(frames):
                step, seconds, ns, size, _, flags, mac, vlan, vlan_type, kind = _FRAME.unpack_from(memory, at)
                frame = memory[at + mac : at + mac + size]
                if flags & _CHECKSUM_MISSING:
                    start, offset = _CHECKSUM.unpack_from(memory, at + mac - _CHECKSUM.size)
                    frame = _with_checksum(frame, start, start + offset)
                if flags & _VLAN:
                    frame = frame[:_MACS] + struct.pack("!HH", vlan_type, vlan) + frame[_MACS:]
                yield seconds * 1_000_000_000 + ns, frame, kind == _OUTGOING
                at += step
            self.taken += frames
            struct.pack_into("=I", memory, block + _STATUS_AT, _KERNEL_S)
            self._next = (self._next + 1) % self._blocks

    def stop(self) -> None:
        """Let no more frames in."""
        nothing = array("Q", struct.pack("=HBBI", _RETURN, 0, 0, 0))
        address, _ = nothing.buffer_info()
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(nothing), address))

    def count(self) -> int:
        """Ask the kernel what has crossed the port; how many of these frames can still be taken."""
        counts = self._socket.getsockopt(_SOL_PACKET, _STATISTICS, _COUNTS.size)
        received, dropped, _ = _COUNTS.unpack(counts)  # since they were last asked for
        self.received += received
        self._dropped += dropped
        return self.received - self._dropped - self.taken


def _with_checksum(frame: bytes, start: int, at: int) -> bytes:
    """What the hardware would do to it: the field holds the sum of what is not from `start` on."""
    return frame[:at] + checksum(frame[start:]).to_bytes(2, "big") + frame[at + 2 :]
