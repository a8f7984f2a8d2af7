"""Extract the UCP datagram from a captured frame, and summarise its message.

A frame with a wrong checksum was damaged, and the receiver's kernel dropped it. One wrong checksum is an exception: a
UDP checksum that covers only the addresses. The sender's kernel writes such a checksum and expects the network card to
replace it by the complete checksum, but a virtual network has no card. Such a frame is intact.

Agents of a run use one port. In the field they may use a different port, so a payload that begins like a UCP message is
accepted from any port.
"""

import struct
from typing import NamedTuple

from harness.archive.packets.pcap import OUTBOUND, Frame
from ucp.messages import (
    MAGIC,
    PORT,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
)

_ETHERNET, _RAW_IP, _COOKED, _IPV4, _COOKED_2 = 1, 101, 113, 228, 276
_ETHERTYPE_IPV4, _ETHERTYPES_VLAN = 0x0800, (0x8100, 0x88A8)
_ETHERTYPES = {0x0806: "ARP", 0x86DD: "IPv6", 0x888E: "EAPOL"}
_PROTOCOLS = {1: "ICMP", 2: "IGMP", 6: "TCP"}
_UDP = 17
_OUTGOING = 4
"""The packet type in Linux cooked headers that marks packets sent by the host itself."""
_ENDS = struct.Struct("!4H")


class NotUcpError(ValueError):
    """An error: the frame does not contain a valid UCP datagram. `reason` is one of a small number of fixed texts."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def unwrap(frame: Frame) -> tuple[bytes, int]:
    """Return the UDP data and the direction of a frame.

    Raises NotUcpError if the frame contains no UDP payload, or is truncated or damaged.
    """
    ethertype, packet, direction = _network_layer(frame)
    if ethertype != _ETHERTYPE_IPV4:
        raise NotUcpError(_ETHERTYPES.get(ethertype, "neither IPv4 nor IPv6"))
    if len(packet) < 20 or packet[0] >> 4 != 4:
        raise NotUcpError("damaged")
    header = 4 * (packet[0] & 15)
    total = int.from_bytes(packet[2:4], "big")
    if header < 20 or total < header:
        raise NotUcpError("damaged")
    if total > len(packet):
        raise NotUcpError("cut short by the capture" if frame.length > len(frame.data) else "damaged")
    if _sum(packet[:header]):
        raise NotUcpError("damaged")
    if packet[9] != _UDP:
        raise NotUcpError(_PROTOCOLS.get(packet[9], "another protocol on IPv4"))
    if int.from_bytes(packet[6:8], "big") & 0x3FFF:
        raise NotUcpError("IP fragment")
    return _udp(packet[12:20], packet[header:total]), direction


def _network_layer(frame: Frame) -> tuple[int, bytes, int]:
    """Return (Ethertype, packet, direction) of a frame."""
    data, link_type, direction = frame.data, frame.link_type, frame.direction
    if link_type == _ETHERNET:
        start = 14
        ethertype = int.from_bytes(data[12:14], "big")
        while ethertype in _ETHERTYPES_VLAN:
            ethertype = int.from_bytes(data[start + 2 : start + 4], "big")
            start += 4
        return ethertype, data[start:], direction
    if link_type in (_RAW_IP, _IPV4):
        return (_ETHERTYPE_IPV4 if data[:1] < b"\x60" else 0x86DD), data, direction
    if link_type == _COOKED and len(data) >= 16:
        outgoing, ethertype, start = int.from_bytes(data[:2], "big"), int.from_bytes(data[14:16], "big"), 16
    elif link_type == _COOKED_2 and len(data) >= 20:
        outgoing, ethertype, start = data[10], int.from_bytes(data[:2], "big"), 20
    else:
        raise NotUcpError("of another kind of link")
    return ethertype, data[start:], OUTBOUND if outgoing == _OUTGOING else direction


def _udp(addresses: bytes, segment: bytes) -> bytes:
    if len(segment) < 8:
        raise NotUcpError("damaged")
    _, port, length, checksum = _ENDS.unpack_from(segment)
    payload = segment[8:length]
    if port != PORT and payload[:2] != MAGIC:
        raise NotUcpError("UDP to other ports")
    if not 8 <= length <= len(segment):
        raise NotUcpError("damaged")
    pseudo_header = addresses + bytes([0, _UDP]) + segment[4:6]
    if checksum and _sum(pseudo_header + segment[:length]) and _sum(pseudo_header) != checksum % 0xFFFF:
        raise NotUcpError("damaged")
    return payload


def _sum(data: bytes) -> int:
    """Return the sum of 16-bit words for the Internet checksum (RFC 1071), modulo 65535.

    If the checksum is correct, the result is 0.
    """
    return int.from_bytes(data + b"\0" if len(data) % 2 else data, "big") % 0xFFFF


RESPONSES: dict[str, str] = {
    BlockAddRequest.NAME: BlockAddResponse.NAME,
    ChainContainQuery.NAME: ChainContainResponse.NAME,
    ChainHashSuccessorQuery.NAME: NextInSequenceResponse.NAME,
    RequestForBlock.NAME: BlockResponse.NAME,
}
"""Name of a request -> name of its response. A Commit Block is neither a request nor a response."""

CARRY_A_BLOCK = frozenset((CommitBlock.NAME, BlockResponse.NAME))
TOP_OF_CHAIN = "top of chain"


class MessageSummary(NamedTuple):
    """The type and content of a message. If the message is encrypted, only its type is known.

    `answer` is the content of a response: approve, disapprove, yes, no, top of chain, or block.
    """

    message: str
    block_hash: bytes | None
    chain_hash: bytes | None
    answer: str | None = None

    @property
    def is_sealed(self) -> bool:
        """True if the content of the message is unknown because the message is encrypted."""
        return self.block_hash is None and self.chain_hash is None

    @property
    def request_key(self) -> tuple[str, bytes | None] | None:
        """The type and the subject of an answer to this request, for comparison with `answers`. None if the message is
        not a request. The agent that sent the request is not included, because answers do not name this agent.
        """
        response = RESPONSES.get(self.message)
        return None if response is None or self.is_sealed else (response, self._subject)

    @property
    def answers(self) -> tuple[str, bytes | None] | None:
        """The type of this answer, and the chain or block that it concerns. None if the message is not an answer."""
        return None if self.answer is None else (self.message, self._subject)

    @property
    def _subject(self) -> bytes | None:
        """The chain or block that a request and its answer have in common.

        A Next In Sequence response also names the found block, but its request names only the chain.
        """
        return self.chain_hash if self.message == NextInSequenceResponse.NAME else self.block_hash or self.chain_hash


def summarize(message: Message) -> MessageSummary:
    match message:
        case BlockAddRequest(block_hash, chain_hash):
            return MessageSummary(message.NAME, block_hash, chain_hash)
        case BlockAddResponse(block_hash, approve, chain_hash):
            return MessageSummary(message.NAME, block_hash, chain_hash, "approve" if approve else "disapprove")
        case CommitBlock(block, chain_hash):
            return MessageSummary(message.NAME, block.block_hash, chain_hash)
        case ChainContainQuery(chain_hash) | ChainHashSuccessorQuery(chain_hash):
            return MessageSummary(message.NAME, None, chain_hash)
        case ChainContainResponse(chain_hash, contained):
            return MessageSummary(message.NAME, None, chain_hash, "yes" if contained else "no")
        case NextInSequenceResponse(chain_hash, block_hash, _):
            return MessageSummary(message.NAME, block_hash, chain_hash, "block" if block_hash else TOP_OF_CHAIN)
        case RequestForBlock(block_hash):
            return MessageSummary(message.NAME, block_hash, None)
        case BlockResponse(block):
            return MessageSummary(message.NAME, block.block_hash, None, "block")
