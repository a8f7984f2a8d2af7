"""Layers of the packet library scapy for UCP headers, messages, blocks and events, to read captures and create packets.

    from scapy.all import IP, UDP, Ether, rdpcap
    from ucp.scapy import UCP, Block, BlockAddRequest, LoggableEvent

    rdpcap("7.pcapng")[0].show()
    block = Block(agent_id=1, events=[LoggableEvent(timestamp_us=5, event_id=1, data=b"x")])
    air = Ether(dst="ff:ff:ff:ff:ff:ff") / IP(src="10.77.0.1", dst="10.79.255.255") / UDP()
    air / UCP(sender=1) / BlockAddRequest(block_hash=block.block_hash, chain_hash=...)

The layers are made from the declarations in `ucp.messages`, `ucp.block` and `ucp.events`, and have the names of the
thesis. Omitted fields are computed: the UDP ports, type and length in the header, the length of an event, and the
timestamp of a block, which is that of its newest event (Section 4.2). Omitted addresses are looked up by scapy, for
example with ARP.

A received datagram gets the layer of its message if and only if the codec accepts the datagram. Otherwise its body is
Raw after the UCP header. A datagram without a UCP header is Raw as a whole.

Datagrams of secured missions have version 3. SecuredUCP is their clear header. The layer Sealed follows
it. `opened` decrypts a Sealed packet with the bundle of a vehicle:

    from ucp.scapy import SecuredUCP, opened
    from ucp.secure.bundle import load_bundle
    from ucp.secure.opening import DatagramOpener

    opened(rdpcap("7.pcapng")[0], DatagramOpener(load_bundle(Path("7.bundle.json")))).show()
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from scapy.config import conf
from scapy.fields import (
    ByteEnumField,
    ByteField,
    FieldLenField,
    IntField,
    LenField,
    LongField,
    PacketField,
    PacketListField,
    ShortField,
    StrFixedLenField,
    XStrField,
    XStrFixedLenField,
    XStrLenField,
)
from scapy.layers.inet import UDP
from scapy.packet import Packet, bind_bottom_up, bind_layers, bind_top_down

from ucp import messages
from ucp.block import BLOCK_FIELDS, HASH_BYTES, hash_digest
from ucp.events import EVENT_FIELDS, MalformedEventsError, decode_event
from ucp.messages import (
    HEADER,
    HEADER_FIELDS,
    MAGIC,
    PORT,
    TYPE_CODES,
    VERSION,
    MalformedDatagramError,
    Message,
    decode,
)
from ucp.secure.envelope import (
    BOOT_BYTES,
    CLEAR,
    CLEAR_FIELDS,
    CONTROL_NAMES,
    NAMES,
    TAG_BYTES,
    read_clear_header,
)
from ucp.secure.envelope import VERSION as SECURED_VERSION
from ucp.wire import FieldKind, Fields

if TYPE_CHECKING:
    from ucp.secure.opening import DatagramOpener


class HashField(XStrFixedLenField):
    def __init__(self, name: str, default: bytes | None = bytes(HASH_BYTES)) -> None:
        super().__init__(name, default, length=HASH_BYTES)


class OptionalHashField(HashField):
    """A scapy field: an optional hash at the end of a message. Its value is None if no bytes are left."""

    def __init__(self, name: str) -> None:
        super().__init__(name, None)

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, Any]:
        return super().getfield(pkt, s) if s else (s, None)

    def addfield(self, pkt: Packet, s: bytes, val: bytes | None) -> bytes:
        return s if val is None else super().addfield(pkt, s, val)


class BlockTimestampField(LongField):
    """A scapy field: the timestamp of a block. A value of None stands for the timestamp of the newest event in the
    block.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, None)  # type: ignore[arg-type]

    def i2m(self, pkt: Packet | None, x: int | None) -> int:
        if x is None and pkt is not None:
            return max((event.timestamp_us for event in pkt.events if isinstance(event, LoggableEvent)), default=0)
        return x or 0


class CiphertextField(XStrField):
    """A scapy field: the encrypted bytes before the authentication tag."""

    def getfield(self, pkt: Packet, s: bytes) -> tuple[bytes, bytes]:
        return s[-TAG_BYTES:], s[:-TAG_BYTES]


_FIELDS: dict[FieldKind, Callable[[str], Any]] = {
    FieldKind.U8: lambda name: ByteField(name, 0),
    FieldKind.U16: lambda name: ShortField(name, 0),
    FieldKind.U32: lambda name: IntField(name, 0),
    FieldKind.U64: lambda name: LongField(name, 0),
    FieldKind.MAGIC: lambda name: StrFixedLenField(name, MAGIC, len(MAGIC)),
    FieldKind.FLAG: lambda name: ByteEnumField(name, 0, {0: "no", 1: "yes"}),
    FieldKind.HASH: HashField,
    FieldKind.BOOT: lambda name: XStrFixedLenField(name, bytes(BOOT_BYTES), BOOT_BYTES),
    FieldKind.OPTIONAL_HASH: OptionalHashField,
    FieldKind.BLOCK: lambda name: PacketField(name, Block(), Block),
}


def _fields(declared: Fields, *last: Any, **special: Any) -> list[Any]:
    """Convert declared message fields to scapy fields, and append `last`. `special` replaces single fields by name."""
    return [*(special[name] if name in special else _FIELDS[kind](name) for name, kind in declared.items()), *last]


class LoggableEvent(Packet):
    """One event in a block."""

    name = "Loggable Event"
    fields_desc = _fields(
        EVENT_FIELDS,
        XStrLenField("data", b"", length_from=lambda event: event.length),
        length=FieldLenField("length", None, length_of="data"),
    )

    def extract_padding(self, s: bytes) -> tuple[bytes, bytes]:
        return b"", s


def _event_or_raw(block: Packet, before: list[Any], last: Packet | None, rest: bytes) -> type[Packet]:
    try:
        decode_event(rest, 0)
    except MalformedEventsError:
        return conf.raw_layer
    return LoggableEvent


class Block(Packet):
    """A block in a message. Event data that is not a sequence of complete events is Raw at the end of `events`."""

    name = "Block"
    fields_desc = _fields(
        BLOCK_FIELDS,
        PacketListField("events", [], next_cls_cb=_event_or_raw),
        timestamp_us=BlockTimestampField("timestamp_us"),
    )

    @property
    def block_hash(self) -> bytes:
        """The block hash BH_n (eq. 3.1). It is not part of the message."""
        return hash_digest(bytes(self))


class UCP(Packet):
    """The header of a message. If `type` and `length` are omitted, they are computed from the message that follows."""

    name = "UCP"
    fields_desc = _fields(
        HEADER_FIELDS,
        version=ByteField("version", VERSION),
        type=ByteEnumField("type", 0, {code: message.NAME for message, code in TYPE_CODES.items()}),
        sender=IntField("sender", 1),
        length=LenField("length", None),
    )

    @classmethod
    def dispatch_hook(cls, _pkt: bytes = b"", *_: Any, **__: Any) -> type[Packet]:
        if not _pkt or (len(_pkt) >= HEADER.size and _pkt[:3] == MAGIC + bytes([VERSION])):
            return cls
        return (
            SecuredUCP if len(_pkt) >= CLEAR.size and _pkt[:3] == MAGIC + bytes([SECURED_VERSION]) else conf.raw_layer
        )

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        try:
            decode(self.original)
        except MalformedDatagramError:
            return conf.raw_layer
        return super().guess_payload_class(payload)

    def mysummary(self) -> str:
        return self.sprintf("UCP %UCP.sender%: %UCP.type%")


class SecuredUCP(Packet):
    """The unencrypted header of a datagram in a secured mission. `length` is computed if it is omitted."""

    name = "Secured UCP"
    fields_desc = _fields(
        CLEAR_FIELDS,
        version=ByteField("version", SECURED_VERSION),
        type=ByteEnumField("type", 0, NAMES | CONTROL_NAMES),
        sender=IntField("sender", 1),
        length=LenField("length", None),
    )

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        try:
            read_clear_header(self.original)
        except MalformedDatagramError:
            return conf.raw_layer
        return Sealed

    def mysummary(self) -> str:
        return self.sprintf("UCP %SecuredUCP.sender%: %SecuredUCP.type%, sealed")


class Sealed(Packet):
    """The encrypted part of a datagram. `opened` decrypts it, except for a revocation, which has no message."""

    name = "Sealed"
    fields_desc = _fields(
        {},
        CiphertextField("ciphertext", b""),
        XStrFixedLenField("tag", bytes(TAG_BYTES), TAG_BYTES),
    )


class BlockAddRequest(Packet):
    name = messages.BlockAddRequest.NAME
    fields_desc = _fields(messages.BlockAddRequest.WIRE)


class BlockAddResponse(Packet):
    name = messages.BlockAddResponse.NAME
    fields_desc = _fields(messages.BlockAddResponse.WIRE)


class CommitBlock(Packet):
    name = messages.CommitBlock.NAME
    fields_desc = _fields(messages.CommitBlock.WIRE)


class ChainContainQuery(Packet):
    name = messages.ChainContainQuery.NAME
    fields_desc = _fields(messages.ChainContainQuery.WIRE)


class ChainContainResponse(Packet):
    name = messages.ChainContainResponse.NAME
    fields_desc = _fields(messages.ChainContainResponse.WIRE)


class ChainHashSuccessorQuery(Packet):
    name = messages.ChainHashSuccessorQuery.NAME
    fields_desc = _fields(messages.ChainHashSuccessorQuery.WIRE)


class NextInSequenceResponse(Packet):
    """An answer in reconcile phase 2. If `block_hash` is None, the answer is "Is Top Of Chain"."""

    name = messages.NextInSequenceResponse.NAME
    fields_desc = _fields(messages.NextInSequenceResponse.WIRE)


class RequestForBlock(Packet):
    name = messages.RequestForBlock.NAME
    fields_desc = _fields(messages.RequestForBlock.WIRE)


class BlockResponse(Packet):
    name = messages.BlockResponse.NAME
    fields_desc = _fields(messages.BlockResponse.WIRE)


LAYERS: dict[type[Message], type[Packet]] = {
    messages.BlockAddRequest: BlockAddRequest,
    messages.BlockAddResponse: BlockAddResponse,
    messages.CommitBlock: CommitBlock,
    messages.ChainContainQuery: ChainContainQuery,
    messages.ChainContainResponse: ChainContainResponse,
    messages.ChainHashSuccessorQuery: ChainHashSuccessorQuery,
    messages.NextInSequenceResponse: NextInSequenceResponse,
    messages.RequestForBlock: RequestForBlock,
    messages.BlockResponse: BlockResponse,
}

for _message, _layer in LAYERS.items():
    bind_layers(UCP, _layer, type=TYPE_CODES[_message])
bind_top_down(UDP, UCP, sport=PORT, dport=PORT)
bind_bottom_up(UDP, UCP, dport=PORT)


def to_layer(message: Message) -> Packet:
    """Convert a message to a scapy layer that can follow a UCP header."""
    return LAYERS[type(message)](message.body())


def opened(packet: Packet, opener: "DatagramOpener") -> Packet:
    """Return the decrypted packet (UCP header and message) for an encrypted one.

    Raises MalformedDatagramError with the reason if the keys do not open the packet.
    """
    header = packet.getlayer(SecuredUCP)
    if header is None:
        raise MalformedDatagramError("not secured")
    return UCP(opener.open(header.do_build()).datagram.encode())


def message_of(packet: Packet) -> tuple[int, int, Message]:
    """Return (sender, sequence number, message) of a packet. Raises MalformedDatagramError if the packet is not a valid
    message.
    """
    header = packet.getlayer(UCP)
    if header is None:
        raise MalformedDatagramError("no UCP")
    return decode(header.do_build())  # without bytes that the link may have added
