"""Agree on keys for one connection, so that an attacker with the secret cannot decrypt a recording (X25519, RFC 7748).

Both ends draw a private key, and exchange the public keys inside the handshake, which the secret authenticates. The
package cryptography is optional. If an end lacks it, the connection is authenticated but not encrypted.
"""

from __future__ import annotations

from typing import Any


class KeyExchange:
    """The private key of one end for one connection."""

    def __init__(self) -> None:
        try:
            from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
        except ImportError:
            self._private = None
        else:
            self._private = X25519PrivateKey.generate()

    @property
    def share(self) -> str | None:
        """The public key for the other end, in hexadecimal, or None if the package cryptography is missing."""
        return None if self._private is None else self._private.public_key().public_bytes_raw().hex()

    def shared(self, share: Any) -> bytes | None:
        """Compute the shared secret of both ends from the public key of the other end. Return None if an end lacks the
        package cryptography.

        Raises ValueError if the public key of the other end is invalid.
        """
        if self._private is None or share is None:
            return None
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

        if not isinstance(share, str):
            raise ValueError("a public key is no text")
        return self._private.exchange(X25519PublicKey.from_public_bytes(bytes.fromhex(share)))
