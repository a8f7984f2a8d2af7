"""Capture all frames of one switch port, through a ring buffer that this process shares with the kernel (AF_PACKET,
TPACKET_V3).

The ring consists of blocks, which the kernel fills one after another. The kernel hands over a block when the block is
full or 100 ms old. A reader that is late still finds all blocks that fit into the ring. The kernel counts the frames
that crossed the port, and the frames that did not fit into the ring. The number of missing frames is therefore always
known. See packet(7), and packet_mmap in the kernel's documentation.

Frames that leave the port have passed netem and nftables, and reach the vehicle. Frames that enter the port have not
passed netem and nftables yet. The kernel does not compute checksums of packets on veth pairs. It marks such packets,
and this module adds their checksums.
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
_OUTGOING = 4  # value of sll_pkttype
_KERNEL_S, _OURS = 0, 1  # owner of a block
_CHECKSUM_MISSING, _VLAN = 1 << 3, 1 << 4  # bits of tp_status
_RETURN = 6  # BPF_RET | BPF_K

_REQUEST = struct.Struct("=7I")
_BLOCK = struct.Struct("=8xIII")  # status, number of frames, offset of the first
_STATUS_AT = 8
_FRAME = struct.Struct("=IIIIIIH6xIH20xB")  # tpacket3_hdr, and sll_pkttype of the sockaddr_ll behind it
_CHECKSUM = struct.Struct("=6xHH")  # virtio_net_hdr: csum_start, csum_offset
_COUNTS = struct.Struct("=III")
_MACS = 12  # bytes of both addresses, before a VLAN tag

BLOCK_BYTES = 1 << 17  # larger than any frame, including those that veth pairs carry before TCP segmentation
_SLOT_BYTES = 2048  # without meaning in TPACKET_V3, but it must divide a block
RETIRE_MS = 100
"""The kernel hands over a block after this number of milliseconds, even if the block is not full."""


class CaptureRing:
    """A ring buffer of `blocks` blocks. The ring captures frames that cross the port after the ring was created.

    Raises OSError if the kernel has no AF_PACKET, if the port does not exist, or if there is too little memory.
    """

    def __init__(self, port: str, blocks: int) -> None:
        self.received = 0
        """Number of frames that crossed the port, at the last call of `count`."""
        self.taken = 0
        self._dropped = 0
        self._blocks = blocks
        self._next = 0
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)  # protocol 0 receives nothing yet
        self._socket.setsockopt(_SOL_PACKET, _VERSION, _TPACKET_V3)
        self._socket.setsockopt(_SOL_PACKET, _VNET_HDR, 1)
        size = blocks * BLOCK_BYTES
        request = _REQUEST.pack(BLOCK_BYTES, blocks, _SLOT_BYTES, size // _SLOT_BYTES, RETIRE_MS, 0, 0)
        self._socket.setsockopt(_SOL_PACKET, _RX_RING, request)
        self._memory = mmap.mmap(self._socket.fileno(), size)
        self._socket.bind((port, _ETH_P_ALL))

    def fileno(self) -> int:
        """Return a file descriptor that becomes readable when a block of frames is available."""
        return self._socket.fileno()

    def take(self) -> Iterator[tuple[int, bytes, bool]]:
        """Yield the available frames as (Unix time in ns, frame, true if the frame leaves the port). One call yields at
        most the content of one full ring buffer.
        """
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
        """Stop capturing frames."""
        nothing = array("Q", struct.pack("=HBBI", _RETURN, 0, 0, 0))
        address, _ = nothing.buffer_info()
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", len(nothing), address))

    def count(self) -> int:
        """Read the counters of the kernel, and update the attributes. Return the number of frames that `take` can still
        yield.
        """
        counts = self._socket.getsockopt(_SOL_PACKET, _STATISTICS, _COUNTS.size)
        received, dropped, _ = _COUNTS.unpack(counts)  # since the last call
        self.received += received
        self._dropped += dropped
        return self.received - self._dropped - self.taken


def _with_checksum(frame: bytes, start: int, at: int) -> bytes:
    """Return the frame with a checksum. Normally the network hardware computes this checksum. The checksum covers the
    bytes from offset `start` on. The kernel has already written the sum of the pseudo-header into the checksum field.
    """
    return frame[:at] + checksum(frame[start:]).to_bytes(2, "big") + frame[at + 2 :]
