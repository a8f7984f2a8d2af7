"""A revocation: the authority takes keys back. It is one signed message, which says all that was ever revoked.

Each has a number, one more than the last one's, so that of two the newer is known. Everybody can check it with the
authority's public key, whatever the epoch, so it needs no encryption: number (u16), count (u16), that many agent IDs
(u32), and the signature, 64 bytes (Ed25519 over a domain tag, the mission's ID and all before).
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from ucp.block import MAX_AGENT_ID

LAST_NUMBER = 2**16 - 1
MAX_REVOKED = 256
"""More do not fit into a datagram, beside all else that one has."""
_TAG = b"UCP revocation\0"
_HEAD = struct.Struct(">HH")
_SIGNATURE_BYTES = 64


class RevocationError(ValueError):
    """Bytes that are no revocation of this mission: one sentence."""


@dataclass(frozen=True)
class Revocation:
    """`revoked` are the agent IDs of all that are revoked so far; numbers begin at 1."""

    number: int
    revoked: frozenset[int]
    signature: bytes

    @classmethod
    def signed(cls, authority: Ed25519PrivateKey, mission: bytes, number: int, revoked: Iterable[int]) -> Self:
        """Raises ValueError for a number or for agents that it cannot say."""
        agents = frozenset(revoked)
        if not 1 <= number <= LAST_NUMBER:
            raise ValueError(f"revocations are numbered 1..{LAST_NUMBER}")
        if not 1 <= len(agents) <= MAX_REVOKED or not all(1 <= agent_id <= MAX_AGENT_ID for agent_id in agents):
            raise ValueError(f"a revocation names 1..{MAX_REVOKED} agents of the IDs 1..{MAX_AGENT_ID}")
        return cls(number, agents, authority.sign(_TAG + mission + _said(number, agents)))

    def encode(self) -> bytes:
        """The message's body."""
        return _said(self.number, self.revoked) + self.signature

    @classmethod
    def decode(cls, body: bytes, authority: bytes, mission: bytes) -> Self:
        """The revocation in a message's body. Raises RevocationError if it is none that the authority signed."""
        if not _HEAD.size <= len(body) <= _HEAD.size + 4 * MAX_REVOKED + _SIGNATURE_BYTES:
            raise RevocationError("of the wrong length")
        number, count = _HEAD.unpack_from(body)
        end = _HEAD.size + 4 * count
        if len(body) != end + _SIGNATURE_BYTES:
            raise RevocationError("of the wrong length")
        said, signature = body[:end], body[end:]
        revoked = frozenset(struct.unpack_from(f">{count}I", body, _HEAD.size))
        if not number or not revoked or _said(number, revoked) != said or max(revoked) > MAX_AGENT_ID or 0 in revoked:
            raise RevocationError("of no form that the authority gives it")
        try:
            Ed25519PublicKey.from_public_bytes(authority).verify(signature, _TAG + mission + said)
        except (InvalidSignature, ValueError):
            raise RevocationError("not signed by the authority of this mission") from None
        return cls(number, revoked, signature)


def _said(number: int, revoked: frozenset[int]) -> bytes:
    """What is signed besides tag and mission: IDs in ascending order, so that one revocation has one form."""
    return _HEAD.pack(number, len(revoked)) + struct.pack(f">{len(revoked)}I", *sorted(revoked))
