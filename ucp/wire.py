"""Kinds of fields in encoded messages.

Messages, blocks and events declare their fields with names and kinds, in the order on the wire. `ucp.scapy` makes its
layers from these declarations. Tests compare the codec and the Wireshark dissector with them.
"""

from collections.abc import Mapping
from enum import Enum
from struct import Struct


class FieldKind(Enum):
    """The type of a field in a message. For a type of fixed size, the value of the enum member is the big-endian format
    of `struct`.
    """

    U8 = "B"
    U16 = "H"
    U32 = "I"
    U64 = "Q"
    MAGIC = "2s"
    FLAG = "?"
    """One byte, 0 or 1."""
    BOOT = "16s"
    """The value in secured datagrams that identifies a start of the sender."""
    HASH = "32s"
    OPTIONAL_HASH = "hash or nothing"
    """The last field of a message: either 32 bytes, or nothing."""
    BLOCK = "block"
    """The last field of a message: an encoded block, which takes all remaining bytes."""


Fields = Mapping[str, FieldKind]

VARIABLE = frozenset((FieldKind.OPTIONAL_HASH, FieldKind.BLOCK))
"""Kinds of fields that have no fixed size."""


def struct_of(fields: Fields) -> Struct:
    """Return a `struct.Struct` that packs and unpacks these fields of fixed size in their order."""
    return Struct("!" + "".join(kind.value for kind in fields.values()))
