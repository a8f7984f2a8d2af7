"""Who takes keys back in a mission: it signs revocations, or has one that was signed before."""

from collections.abc import Iterable

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from harness.play.keyring.key_directory import AUTHORITY_NAME, REVOCATION_NAME, Home, KeysError, listed
from ucp.secure.bundle import KeySet, PublicKeys
from ucp.secure.revocation import Revocation


class Authority:
    """Each revocation says all that were revoked so far; `last` was made before, if any was.

    Without its `private_key` there are no others. What is revoked here is written nowhere: a mission that is played
    leaves what is at home as it was.
    """

    def __init__(self, public: PublicKeys, private_key: bytes | None, last: Revocation | None = None) -> None:
        self._public = public
        self._private_key = private_key
        self._last = last

    @classmethod
    def of(cls, keys: KeySet) -> "Authority":
        """Of keys that were made just now."""
        return cls(keys.public, keys.authority)

    @classmethod
    def in_directory(cls, home: Home, public: PublicKeys) -> "Authority":
        """By what is there: the authority's key, the last revocation, both, or nothing. Raises KeysError."""
        private_key = home.authority(public) if (home.directory / AUTHORITY_NAME).exists() else None
        return cls(public, private_key, home.revocation(public))

    @property
    def revoked(self) -> frozenset[int]:
        """All by now."""
        return self._last.revoked if self._last else frozenset()

    def refuse(self, agents: Iterable[int], directory: object) -> None:
        """Raises KeysError if it cannot revoke these. `directory` is where its keys were looked for."""
        lacking = {*agents} - self.revoked
        if self._private_key is not None or not lacking:
            return
        made = f"{REVOCATION_NAME} there revokes {listed(self.revoked)} alone" if self._last else "none is there"
        raise KeysError(
            f"to revoke {listed(lacking)} takes the authority's key, or a revocation made before, and {made}: name the "
            f"directory that `ucp-harness keys new` made, or write {directory}/{REVOCATION_NAME} with "
            "`ucp-harness keys revoke --out`"
        )

    def revoke(self, agent_id: int) -> bytes:
        """The revocation of this one, as a message's body: that which was made before if it says so, or the next."""
        if self._last is None or agent_id not in self._last.revoked:
            assert self._private_key is not None, "was refused"
            signer = Ed25519PrivateKey.from_private_bytes(self._private_key)
            number = self._last.number + 1 if self._last else 1
            self._last = Revocation.signed(signer, self._public.mission, number, self.revoked | {agent_id})
        return self._last.encode()
