"""Seal event data so that only the depot can read it. The vehicles that carry the data cannot read it, and neither can
attackers that capture a vehicle.

Sealing is HPKE (RFC 9180) in base mode: DHKEM(X25519, HKDF-SHA256), HKDF-SHA256, ChaCha20-Poly1305, and one message per
key. `info` contains mission, agent and timestamp, so sealed data of one block is not valid in another block. Additional
data (AAD) could contain these values instead, but some HPKE libraries do not support AAD.

A vehicle draws a random ephemeral key for each block. If the key followed from the vehicle's private key and the
events, the holder of the private key could guess the events of a block, and confirm each guess. In virtual time, equal
runs must give equal bytes. There, the ephemeral key is derived from the private key and from all data of the block.
HPKE libraries do not accept an ephemeral key, so this module seals with its own code. It opens with the HPKE of the
library.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hpke
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.hmac import HMAC
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from ucp.core import Seal
from ucp.secure.bundle import KEY_BYTES, Bundle

_TAG = b"UCP event data\0"
_BLOCK = struct.Struct(">IQ")
_NONCE_BYTES = 12
_KEM_SUITE = b"KEM" + struct.pack(">H", 0x0020)  # DHKEM(X25519, HKDF-SHA256)
_SUITE = b"HPKE" + struct.pack(">HHH", 0x0020, 0x0001, 0x0003)  # ..., HKDF-SHA256, ChaCha20-Poly1305
_LIBRARY = hpke.Suite(hpke.KEM.X25519, hpke.KDF.HKDF_SHA256, hpke.AEAD.CHACHA20_POLY1305)
_BASE_MODE = b"\0"


class NotOpenedError(Exception):
    """An error: this key cannot decrypt the event data. The message is one sentence."""


@dataclass(frozen=True)
class Depot:
    """The depot's private key, which decrypts the sealed event data of a mission."""

    mission: bytes
    private_key: bytes = field(repr=False)

    @property
    def public_key(self) -> bytes:
        return X25519PrivateKey.from_private_bytes(self.private_key).public_key().public_bytes_raw()

    def open(self, sealed: bytes, agent_id: int, timestamp_us: int) -> bytes:
        """Decrypt the event data of the block with this agent ID and timestamp. Raises NotOpenedError."""
        key: Any = X25519PrivateKey.from_private_bytes(self.private_key)
        try:
            return _LIBRARY.decrypt(sealed, key, _info(self.mission, agent_id, timestamp_us))
        except (InvalidTag, ValueError):
            raise NotOpenedError("not sealed to this depot by the agent that it names, or damaged") from None


def make_seal(bundle: Bundle, draw_key: Callable[[], bytes] | None = None) -> Seal | None:
    """Return the function with which this vehicle seals event data. Return None if its mission does not seal them.

    `draw_key` returns a random ephemeral key, 32 bytes. Without it, ephemeral keys are derived, for virtual time.
    """
    depot = bundle.public.depot
    if depot is None:
        return None
    recipient, mission, agent_id = X25519PublicKey.from_public_bytes(depot), bundle.public.mission, bundle.agent_id

    def seal(event_data: bytes, timestamp_us: int) -> bytes:
        info = _info(mission, agent_id, timestamp_us)
        ephemeral = draw_key() if draw_key is not None else _derived_key(bundle, depot + info + event_data)
        return _hpke_seal(event_data, recipient, X25519PrivateKey.from_private_bytes(ephemeral), info)

    return seal


def _derived_key(bundle: Bundle, data: bytes) -> bytes:
    """Compute an ephemeral key from the vehicle's private key and all data of a block."""
    derivation = HMAC(bundle.private_key, SHA256())
    derivation.update(b"UCP ephemeral key\0" + data)
    return derivation.finalize()


def _hpke_seal(plain: bytes, recipient: X25519PublicKey, ephemeral: X25519PrivateKey, info: bytes) -> bytes:
    """Encrypt one message with HPKE in base mode.

    Return the ephemeral public key (32 bytes), the ciphertext and the tag (16 bytes).
    """
    enc = ephemeral.public_key().public_bytes_raw()
    key, nonce = key_schedule(ephemeral.exchange(recipient), enc, recipient.public_bytes_raw(), info)
    return enc + ChaCha20Poly1305(key).encrypt(nonce, plain, None)


def key_schedule(shared: bytes, enc: bytes, recipient: bytes, info: bytes) -> tuple[bytes, bytes]:
    """Return the key and the first nonce for a Diffie-Hellman secret (RFC 9180, Sections 4.1 and 5.1)."""
    secret = _expand(_KEM_SUITE, _extract(_KEM_SUITE, b"", b"eae_prk", shared), b"shared_secret", enc + recipient)
    context = _BASE_MODE + _extract(_SUITE, b"", b"psk_id_hash", b"") + _extract(_SUITE, b"", b"info_hash", info)
    secret = _extract(_SUITE, secret, b"secret", b"")
    return _expand(_SUITE, secret, b"key", context), _expand(_SUITE, secret, b"base_nonce", context, _NONCE_BYTES)


def _info(mission: bytes, agent_id: int, timestamp_us: int) -> bytes:
    return _TAG + mission + _BLOCK.pack(agent_id, timestamp_us)


def _extract(suite: bytes, salt: bytes, label: bytes, secret: bytes) -> bytes:
    """LabeledExtract (RFC 9180, Section 4)."""
    extraction = HMAC(salt or bytes(KEY_BYTES), SHA256())
    extraction.update(b"HPKE-v1" + suite + label + secret)
    return extraction.finalize()


def _expand(suite: bytes, secret: bytes, label: bytes, info: bytes, length: int = KEY_BYTES) -> bytes:
    """LabeledExpand (RFC 9180, Section 4)."""
    labeled = length.to_bytes(2, "big") + b"HPKE-v1" + suite + label + info
    return HKDFExpand(SHA256(), length, labeled).derive(secret)
