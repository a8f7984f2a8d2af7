"""A revocation: a message in which the authority lists all vehicles whose keys are revoked so far.

The authority numbers its revocations. The number is information for people: receivers revoke all agents that any
revocation lists. The body of a revocation consists of: number (u16), count (u16), `count` agent IDs (u32), and the
signature (64 bytes). The signature is Ed25519 over a domain tag, the mission's ID and the body before the signature.
"""

import hashlib
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from ucp.block import MAX_AGENT_ID

LAST_NUMBER = 2**16 - 1
MAX_REVOKED = 256
"""Maximum number of revoked vehicles. A revocation must fit into one datagram."""
_TAG = b"UCP revocation\0"
_HEAD = struct.Struct(">HH")
_SIGNATURE_BYTES = 64


class RevocationError(ValueError):
    """An error: these bytes are not a revocation of this mission. The message is one sentence."""


@dataclass(frozen=True)
class Revocation:
    """A revocation with the signature of the authority. `revoked` holds the IDs of all agents that are revoked so far.
    Revocations are numbered from 1.
    """

    number: int
    revoked: frozenset[int]
    signature: bytes

    @classmethod
    def signed(cls, authority: Ed25519PrivateKey, mission: bytes, number: int, revoked: Iterable[int]) -> Self:
        """Return a revocation signed by `authority`. Raises ValueError if the number or an ID is out of range."""
        agents = frozenset(revoked)
        if not 1 <= number <= LAST_NUMBER:
            raise ValueError(f"revocations are numbered 1..{LAST_NUMBER}")
        if not 1 <= len(agents) <= MAX_REVOKED or not all(1 <= agent_id <= MAX_AGENT_ID for agent_id in agents):
            raise ValueError(f"a revocation names 1..{MAX_REVOKED} agents of the IDs 1..{MAX_AGENT_ID}")
        return cls(number, agents, authority.sign(_TAG + mission + _signed_part(number, agents)))

    def encode(self) -> bytes:
        """Return the body of the message."""
        return _signed_part(self.number, self.revoked) + self.signature

    @classmethod
    def decode(cls, body: bytes, authority: bytes, mission: bytes) -> Self:
        """Parse a revocation from the body of a message. Raises RevocationError if the body is malformed, or if the
        signature of the authority is missing or wrong.
        """
        if not _HEAD.size <= len(body) <= _HEAD.size + 4 * MAX_REVOKED + _SIGNATURE_BYTES:
            raise RevocationError("it has the wrong length")
        number, count = _HEAD.unpack_from(body)
        end = _HEAD.size + 4 * count
        if len(body) != end + _SIGNATURE_BYTES:
            raise RevocationError("it has the wrong length")
        signed_part, signature = body[:end], body[end:]
        revoked = frozenset(struct.unpack_from(f">{count}I", body, _HEAD.size))
        canonical = _signed_part(number, revoked) == signed_part
        if not number or not revoked or not canonical or max(revoked) > MAX_AGENT_ID or 0 in revoked:
            raise RevocationError("its number must be 1 or more, and its agent IDs 1 or more in ascending order")
        try:
            Ed25519PublicKey.from_public_bytes(authority).verify(signature, _TAG + mission + signed_part)
        except (InvalidSignature, ValueError):
            raise RevocationError("the authority of this mission did not sign it") from None
        return cls(number, revoked, signature)


def listed_agents(body: bytes) -> frozenset[int] | None:
    """Return the agents that the body of a revocation lists, without verifying the signature. Return None if the body
    has a wrong length.
    """
    if len(body) < _HEAD.size:
        return None
    _, count = _HEAD.unpack_from(body)
    if not 1 <= count <= MAX_REVOKED or len(body) != _HEAD.size + 4 * count + _SIGNATURE_BYTES:
        return None
    return frozenset(struct.unpack_from(f">{count}I", body, _HEAD.size))


def revocations_digest(revoked: Iterable[int]) -> int:
    """Return the first 16 bits of the SHA-256 of the agent IDs (u32) in ascending order. 0 stands for no agents.

    A set of agents whose digest would be 0 has the digest 1.
    """
    agents = sorted(revoked)
    if not agents:
        return 0
    digest = hashlib.sha256(struct.pack(f">{len(agents)}I", *agents)).digest()
    return int.from_bytes(digest[:2], "big") or 1


def _signed_part(number: int, revoked: frozenset[int]) -> bytes:
    """Return the body without its signature. IDs are in ascending order, so each revocation has one encoding."""
    return _HEAD.pack(number, len(revoked)) + struct.pack(f">{len(revoked)}I", *sorted(revoked))
