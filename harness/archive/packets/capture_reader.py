"""Read one packet capture file. It contains the datagrams that one vehicle, or a separate observer, sent or received.

A capture that `ucp-harness run --capture` made names its vehicle in a comment. A capture from the field has no comment.
The vehicle of such a capture is the sender of the outbound datagrams in the file. If the file has no outbound
datagrams, the vehicle is the one whose ID is the name of the file, such as `7.pcap`. If the name is no ID either, the
capture belongs to a separate observer.

The reader extracts the UCP datagram from each captured frame, and summarises its message. A frame with a wrong checksum
was damaged, and the receiver's kernel dropped it. One wrong checksum is an exception: a UDP checksum that covers only
the addresses. The sender's kernel writes such a checksum and expects the network card to replace it by the complete
checksum, but a virtual network has no card. Such a frame is intact.

Agents of a run use one port. In the field they may use a different port, so a payload that begins like a UCP message is
accepted from any port.
"""

import hashlib
import struct
from array import array
from collections import Counter
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field, ValidationError

from harness.archive.exports import AgentId
from harness.archive.packets.pcap import INBOUND, OUTBOUND, CaptureFile, Frame
from ucp.block import MAX_AGENT_ID
from ucp.messages import (
    MAGIC,
    PORT,
    TYPE_CODES,
    BlockAddRequest,
    BlockAddResponse,
    BlockResponse,
    ChainContainQuery,
    ChainContainResponse,
    ChainHashSuccessorQuery,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
    RequestForBlock,
    decode,
)
from ucp.secure.envelope import CHALLENGE, CONTROL_NAMES, ECHO, REVOCATION, VERSION, read_clear_header

if TYPE_CHECKING:
    from ucp.secure.opening import DatagramOpener


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
        """The type and the subject of an answer to this request. Another message may be the answer if its attribute
        `answers` has the same value. None if the message is not a request. The agent that sent the request is not
        included, because answers do not name this agent.
        """
        response = RESPONSES.get(self.message)
        return None if response is None or self.is_sealed else (response, self._subject)

    @property
    def answers(self) -> tuple[str, bytes | None] | None:
        """The type of this answer, and the chain or block that it concerns. None if the message is not an answer."""
        return None if self.answer is None else (self.message, self._subject)

    @property
    def _subject(self) -> bytes | None:
        """The chain or block that the message concerns. A request and its answer concern the same chain or block. The
        subject of a Next In Sequence response is the chain, because its request does not name the found block.
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


SECURED = bytes([VERSION])
NAMES = {code: message.NAME for message, code in TYPE_CODES.items()}
_LAST_NS = 2**63 - 1

ListenerName = int | str
"""The ID of the vehicle whose network interface was captured, or the name of a separate observer."""


class CaptureComment(BaseModel):
    """The comment that the harness writes into a packet capture, as JSON in the section header. `epoch_us` is the
    capture time of mission second 0.
    """

    ucp_harness: Literal[1]
    vehicle: AgentId
    epoch_us: Annotated[int, Field(ge=0, lt=2**63, strict=True)]
    speedup: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Datagram:
    """A datagram, identified by its bytes, with all its occurrences in all captures.

    `seen` is a flat array, because there may be millions of occurrences. Each occurrence takes two elements: the time
    in ns, and a number that encodes the capture and the direction of the frame.
    """

    __slots__ = ("seen", "sender", "sequence", "summary")

    def __init__(self, sender: int, sequence: int, summary: MessageSummary) -> None:
        self.sender = sender
        self.sequence = sequence
        self.summary = summary
        self.seen = array("q")

    def sightings(self) -> Iterable[tuple[int, int, int]]:
        """Return (time in ns, number of the capture, direction) for each occurrence of the datagram in a capture."""
        seen = self.seen
        return ((seen[i], seen[i + 1] >> 2, seen[i + 1] & 3) for i in range(0, len(seen), 2))


class Capture:
    """A packet capture file. The file covers the time from `began_ns` to `ended_ns`. Both are None if this time is
    unknown. `sees_itself` is true if the file also contains the datagrams that its own vehicle sent.
    """

    def __init__(self, number: int, path: Path) -> None:
        self.number = number
        self.path = path
        self.comment: CaptureComment | None = None
        self.vehicle: int | None = None
        self.began_ns: int | None = None
        self.ended_ns: int | None = None
        self.sees_itself = False
        self.frames = 0
        self.dropped: int | None = None
        self.not_ucp: Counter[str] = Counter()
        self.malformed: Counter[str] = Counter()
        self.problems: list[str] = []

    @property
    def name(self) -> ListenerName:
        return self.path.stem if self.vehicle is None else self.vehicle

    def listening(self, time_ns: int) -> bool:
        return self.began_ns is not None and self.ended_ns is not None and self.began_ns <= time_ns <= self.ended_ns

    def read(
        self, datagrams: dict[bytes, Datagram], most_frames: int | None = None, opener: "DatagramOpener | None" = None
    ) -> None:
        """Read the file, or only its first frames, and add its datagrams to `datagrams`. `opener` decrypts secured
        datagrams.

        Raises CaptureError if the file is not a capture.
        """
        file = CaptureFile(self.path)
        first_ns, last_ns = _LAST_NS, -1
        sent_by: Counter[int] = Counter()
        senders: set[int] = set()  # senders of datagrams without a direction in the file
        frames = iter(file)
        for frame in islice(frames, most_frames):
            self.frames += 1
            if not 0 <= frame.time_ns <= _LAST_NS:
                self.not_ucp["at an impossible time"] += 1
                continue
            first_ns, last_ns = min(first_ns, frame.time_ns), max(last_ns, frame.time_ns)
            try:
                datagram, direction = _datagram(frame, datagrams, opener)
            except NotUcpError as not_ucp:
                self.not_ucp[not_ucp.reason] += 1
            except MalformedDatagramError as malformed:
                self.malformed[malformed.reason] += 1
            else:
                datagram.seen.append(frame.time_ns)
                datagram.seen.append(self.number << 2 | direction)
                if direction == OUTBOUND:
                    sent_by[datagram.sender] += 1
                elif not direction:
                    senders.add(datagram.sender)
        self.frames += sum(1 for _ in frames)
        self._set_origin(file, sent_by)
        self.sees_itself = self.comment is not None or bool(sent_by) or self.vehicle in senders
        epoch_ns = self.comment.epoch_us * 1000 if self.comment else first_ns
        began_ns = min(first_ns, epoch_ns) if file.started_ns is None else file.started_ns
        ended_ns = last_ns if file.ended_ns is None else max(last_ns, file.ended_ns)
        if began_ns <= ended_ns:
            self.began_ns, self.ended_ns = began_ns, ended_ns

    def _set_origin(self, file: CaptureFile, sent_by: Counter[int]) -> None:
        self.dropped = file.dropped
        self.comment = self._parse_comment(file.comment)
        if self.comment:
            self.vehicle = self.comment.vehicle
        elif sent_by:
            self.vehicle = sent_by.most_common(1)[0][0]
        elif self.path.stem.isdecimal() and 1 <= int(self.path.stem[:6]) <= MAX_AGENT_ID:
            self.vehicle = int(self.path.stem)
        if file.problem:
            self.problems.append(f"{self.path}: {file.problem}")
        if self.dropped:
            self.problems.append(
                f"{self.path}: frames that the capture itself missed, and that look like losses: {self.dropped}"
            )
        if cut := self.not_ucp["cut short by the capture"]:
            self.problems.append(
                f"{self.path}: frames that were cut short, and look like losses: {cut}; capture with -s 0"
            )

    def _parse_comment(self, comment: bytes | None) -> CaptureComment | None:
        if comment is None or b'"ucp_harness"' not in comment:
            return None
        try:
            return CaptureComment.model_validate_json(comment)
        except ValidationError:
            self.problems.append(
                f"{self.path}: its comment is damaged or of a newer version: it is read as a capture from the field"
            )
            return None

    def direction(self, sender: int, direction: int) -> int:
        """Return the direction of a datagram. If the file contains no directions, datagrams that the vehicle itself
        sent count as outbound.
        """
        return direction or (OUTBOUND if sender == self.vehicle else INBOUND)


def _plain(payload: bytes) -> Datagram:
    sender, sequence, message = decode(payload)
    return Datagram(sender, sequence, summarize(message))


_CONTROL_REASONS = {
    REVOCATION: "a revocation of keys",
    CHALLENGE: "a challenge, which asks for a sign of life",
    ECHO: "an echo, which answers a challenge",
}
"""Type of a control datagram -> the reason why it contains no message."""


def _secured(payload: bytes, opener: "DatagramOpener | None") -> Datagram:
    """Return a datagram of a secured mission. Without `opener`, only its sender, sequence number and type are known."""
    clear = read_clear_header(payload)
    if clear.type in CONTROL_NAMES:
        raise NotUcpError(_CONTROL_REASONS[clear.type])
    if opener is not None:
        sender, sequence, message = opener.open(payload).datagram
        return Datagram(sender, sequence, summarize(message))
    return Datagram(clear.sender, clear.sequence, MessageSummary(NAMES[clear.type], None, None))


def _datagram(frame: Frame, datagrams: dict[bytes, Datagram], opener: "DatagramOpener | None") -> tuple[Datagram, int]:
    payload, direction = unwrap(frame)
    key = hashlib.blake2b(payload, digest_size=16).digest()
    datagram = datagrams.get(key)
    if datagram is None:
        datagram = datagrams[key] = _secured(payload, opener) if payload[2:3] == SECURED else _plain(payload)
    return datagram, direction
