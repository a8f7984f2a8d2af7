"""Create agents that check signatures. Also create the datagrams that an attacker signs with the keys of a captured
vehicle.

The real code in `ucp.secure` decides which datagrams an agent accepts. This module makes no assumptions about it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from harness.errors import extra
from harness.play.rogue.lies import made_block
from ucp.agent import Agent
from ucp.messages import CARRY_A_BLOCK, Message

if TYPE_CHECKING:
    from ucp.secure.session import Session

BOOT = b"in a proof".ljust(16, b"\0")
ATTACKERS_BOOT = b"later than that".ljust(16, b"\0")
"""The boot identifier in the attacker's datagrams. It is later than the boot identifier of the captured vehicle, so
agents drop the datagrams that the captured vehicle itself sends.
"""


class SecurityGate:
    """The keys of a secured mission. The attacker has the keys of vehicle `captured`. Raises MachineError without a
    cryptography library.
    """

    def __init__(self, roster: Iterable[int], captured: int) -> None:
        with extra("secure", "--captured"):
            from ucp.secure.bundle import KeySet
        self._keys = KeySet.derived(b"the keys of a proof".ljust(32), roster)
        self._roster = tuple(roster)
        self._captured = captured
        self._sequence = 0
        self._sessions: dict[int, Session] = {}
        """Sender -> the session in which the attacker sends in the name of this sender."""

    def agent(self, agent_id: int, *arguments: Any, revoked: bool = False, **options: Any) -> Agent:
        """Return an agent that checks signatures. If `revoked` is true, the agent knows that the captured vehicle is
        revoked.
        """
        from ucp.secure.secured_agent import SecuredAgent
        from ucp.secure.session import Session

        session = Session(self._keys.bundle(agent_id), BOOT, has_budgets=False)
        session.set_clock(0.0)  # the agent has flown since the start of the mission
        agent = SecuredAgent(session, agent_id, *arguments, **options)
        if revoked:
            agent.revoke(self._revocation(), 0.0)
        return agent

    def sealed(self, message: Message, now: float, *, sender: int | None = None, genuine: bool = False) -> bytes:
        """Return a new encrypted datagram with this message, in the name of the captured vehicle or of `sender`.

        If `genuine` is true, the block in the message has the signature of its author, which the attacker received
        together with the block. Otherwise the attacker signs the block with the captured key.

        An answer names the request that it answers. The datagram names a new request of the captured vehicle. No agent
        has received this request, so no agent can know a newer one.
        """
        from ucp.secure.block_signature import sign_block
        from ucp.secure.sealed_datagrams import AnsweredRequest
        from ucp.secure.session import Session

        self._sequence += 1
        sender = sender or self._captured
        if sender not in self._sessions:
            bundle = replace(self._keys.bundle(self._captured), agent_id=sender)
            self._sessions[sender] = Session(bundle, ATTACKERS_BOOT)
        session = self._sessions[sender]
        session.epochs.set_clock(now)
        signature = None
        if type(message) in CARRY_A_BLOCK:
            block = message.block  # type: ignore[union-attr]
            signer = self._key(block.agent_id if genuine else self._captured)
            signature = sign_block(signer, session.mission, block.block_data())
        request = AnsweredRequest(self._captured, ATTACKERS_BOOT, self._sequence)
        return session.seal(self._sequence, message, request, signature, 0)

    def forged(self, message: Message, receiver: int, now: float) -> Iterator[bytes]:
        """Yield forged datagrams with this message: one in the name of a third vehicle, and one with a block in the
        receiver's name.

        The attacker has neither the keys of the third vehicle nor those of the receiver.
        """
        another = next((member for member in self._roster if member not in (receiver, self._captured)), None)
        if another is not None:
            yield self.sealed(message, now, sender=another)
        if type(message) in CARRY_A_BLOCK:
            others = made_block(receiver, message.block.timestamp_us)  # type: ignore[union-attr]
            yield self.sealed(replace(message, block=others), now)  # type: ignore[arg-type]

    def _key(self, agent_id: int) -> Any:
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        return Ed25519PrivateKey.from_private_bytes(self._keys.vehicles[agent_id])

    def _revocation(self) -> bytes:
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        from ucp.secure.revocation import Revocation

        signer = Ed25519PrivateKey.from_private_bytes(self._keys.authority)
        return Revocation.signed(signer, self._keys.public.mission, 1, [self._captured]).encode()
