"""The revocations that an agent knows. A revocation is a list of agents whose keys are no longer valid, signed by the
authority of the mission.

A revoked agent stays revoked: an agent counts as revoked if any known revocation lists it. The files of the authority
may be lost, copied or used in any order, so a revocation with a higher number may omit agents that an earlier one
lists. An agent therefore keeps each revocation that lists a further agent.

Each datagram contains a digest of all agents that its sender knows to be revoked. An agent whose own digest differs
broadcasts its revocations.
"""

from collections.abc import Iterable
from contextlib import suppress

from ucp.secure.revocation import Revocation, RevocationError, listed_agents, revocations_digest


class KnownRevocations:
    """The revocations that an agent keeps, all signed by the authority. Each of these revocations lists an agent that
    no other revocation lists.
    """

    def __init__(self, authority: bytes, mission: bytes) -> None:
        self._authority = authority
        self._mission = mission
        self._held: tuple[Revocation, ...] = ()
        self.revoked: frozenset[int] = frozenset()
        """All revoked agents."""
        self.digest = 0
        """A 16-bit digest of the set of revoked agents. 0 stands for the empty set."""

    @property
    def bodies(self) -> tuple[bytes, ...]:
        """The encoded bodies of the revocations."""
        return tuple(revocation.encode() for revocation in self._held)

    def adds_nothing(self, body: bytes) -> bool:
        """Return whether the encoded revocation lists only agents that are already revoked. Its signature is not
        verified.
        """
        listed = listed_agents(body)
        return listed is not None and listed <= self.revoked

    def add(self, body: bytes) -> bool:
        """Add an encoded revocation. Return whether it lists a newly revoked agent. Raises RevocationError."""
        revocation = Revocation.decode(body, self._authority, self._mission)
        if revocation.revoked <= self.revoked:
            return False
        self._held = (*(held for held in self._held if not held.revoked <= revocation.revoked), revocation)
        self.revoked |= revocation.revoked
        self.digest = revocations_digest(self.revoked)
        return True

    def restore(self, bodies: Iterable[bytes]) -> None:
        """Add revocations that were read from the disk. Skip those that the current authority did not sign."""
        for body in bodies:
            with suppress(RevocationError):
                self.add(body)
