"""An agent behind keys: the same agent with the same face, whose datagrams are sealed and opened on the way.

The protocol knows nothing of it. What reaches its handlers is authentic and fresh, of a sender whose keys are not
revoked; a block is its maker's; a response answers the newest request of its kind that is known. Whatever else the
radio delivers is counted in `dropped`, as ever, and nothing else happens.

Its trace has datagrams in their plain form, as everybody's, so that it is read and judged like any other; those that
were dropped are there as they came.
"""

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from ucp.agent import Agent, why_not_handled
from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.secure._signatures import BlockSignatures
from ucp.secure.envelope import BOOT_BYTES, CLEAR, LAST_SEQUENCE, REQUESTS, REVOCATION, Clear
from ucp.secure.revocation import Revocation, RevocationError
from ucp.secure.sealed_datagrams import Opened, Request
from ucp.secure.session import Session
from ucp.store import SecuredState, StoredState
from ucp.trace import Commanded, Recorded, in_base64

TOLD_AGAIN_S = 5.0
"""Mission seconds from one telling of a revocation to the next, at least."""
_BOOT_TIME = struct.Struct("!Q")


class Outgoing(NamedTuple):
    """A datagram to broadcast: as it goes on the air, and what it says, unless it is a revocation."""

    sealed: bytes
    sequence: int = 0
    message: Message | None = None
    plain: Recorded | None = None


def boot_of(started_us: int, chance: bytes) -> bytes:
    """Which life of a vehicle: when it began, in microseconds UTC, and 8 bytes of chance."""
    boot = _BOOT_TIME.pack(started_us) + chance
    assert len(boot) == BOOT_BYTES
    return boot


class SecuredAgent(Agent):
    """An agent with a session; all other arguments are Agent's. Raises ValueError for a roster without keys."""

    def __init__(self, session: Session, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        without = sorted(self.roster - session.public_keys.keys())
        if without or session.agent_id != self.agent_id:
            raise ValueError(
                f"the keys belong to agent {session.agent_id}, and keys of {without or 'others'} are missing"
            )
        self.session = session
        self.revocation: Revocation | None = None
        """The newest that is known."""
        self.problem: str | None = None
        """Why it no longer sends, if so."""
        self._signatures = BlockSignatures(session, self.state)
        self._answers: dict[int, Request] = {}
        """Sequence of a response in the outbox -> what it answers."""
        self._tells = False
        self._told_at: float | None = None

    @property
    def signatures(self) -> Mapping[bytes, bytes]:
        """The makers' signatures of all blocks that it holds, by block hash."""
        return self._signatures.held()

    # From the air

    def receive_datagram(self, data: bytes, now: float) -> None:
        self.session.epochs.look_at(now)
        try:
            clear = self.session.arithmetic.read(data)
            if why := self._why_not_opened(clear):
                raise MalformedDatagramError(why)
            if clear.type == REVOCATION:
                if not self.revoke(data[CLEAR.size :], now, {"from": clear.sender}):
                    raise MalformedDatagramError("known already")
                return
            opened = self.session.open(data, clear)
            if clear.revocations < self._revocations:
                self._tell(now)
            self._check(opened)
        except MalformedDatagramError as malformed:
            self._drop(now, malformed.reason, Recorded(in_base64(data)))
            return
        self._handle_opened(opened, now)

    def _why_not_opened(self, clear: Clear) -> str | None:
        if clear.sender == self.agent_id:
            return "own sender"
        if clear.sender not in self.roster:
            return "sender not on the roster"
        if clear.type != REVOCATION and self.revocation is not None and clear.sender in self.revocation.revoked:
            return "revoked sender"
        return None

    def _check(self, opened: Opened) -> None:
        """Raises MalformedDatagramError for an authentic message that must not be handled."""
        sender, _, message = opened.said
        if why := why_not_handled(self.agent_id, self.roster, sender, message):
            raise MalformedDatagramError(why)
        if opened.request is not None and not self.session.is_asked(opened.request, opened.clear.type):
            raise MalformedDatagramError("answers no request")
        if type(message) in CARRY_A_BLOCK and not self._signatures.is_genuine(message.block, opened.block_signature):  # type: ignore[union-attr]
            raise MalformedDatagramError("block not signed by its maker")

    def _handle_opened(self, opened: Opened, now: float) -> None:
        clear, (sender, sequence, message) = opened.clear, opened.said
        waiting = len(self._core.outbox)
        super().receive_message(sender, sequence, message, now, opened.recorded)
        if clear.type in REQUESTS:
            request = Request(sender, clear.boot, sequence)
            self._answers.update((answer, request) for answer, _, _ in self._core.outbox[waiting:])
        if type(message) in CARRY_A_BLOCK:
            self._signatures.forget_unless_held(message.block)  # type: ignore[union-attr]

    # To the air

    def datagrams_to_send(self) -> list[bytes]:
        return [outgoing.sealed for outgoing in self.sealed_to_send()]

    def sealed_to_send(self) -> Sequence[Outgoing]:
        """What to broadcast, in order; empties the outbox."""
        if not self._tells and not self._core.outbox:
            return ()
        self.session.epochs.look_at(self.state.now)
        outgoing = []
        if self._tells and self.revocation is not None:
            self._tells = False
            outgoing.append(Outgoing(self.session.tell(self.revocation.number, self.revocation.encode())))
        for sequence, message, plain in self._taken_from_outbox():
            if sequence > LAST_SEQUENCE:
                self.problem = "it has used all sequence numbers of this life: it sends no more until it starts anew"
                continue
            signature = self.signatures.get(message.block.block_hash) if type(message) in CARRY_A_BLOCK else None  # type: ignore[union-attr]
            request = self._answers.pop(sequence, None)
            sealed = self.session.seal(sequence, message, request, signature, self._revocations)
            outgoing.append(Outgoing(sealed, sequence, message, plain))
        return outgoing

    # Revocations

    @property
    def _revocations(self) -> int:
        return 0 if self.revocation is None else self.revocation.number

    def revoke(self, body: bytes, now: float, came: Mapping[str, Any] | None = None) -> bool:
        """The authority says whose keys are revoked; whether that is new.

        Raises MalformedDatagramError if the authority does not say so.
        """
        if 0 < int.from_bytes(body[:2], "big") <= self._revocations:
            return False
        try:
            revocation = Revocation.decode(body, self.session.authority, self.session.mission)
        except RevocationError:
            raise MalformedDatagramError("not signed by the authority") from None
        self.revocation = revocation
        request = {"command": "revoke", "revocation": in_base64(body), **(came or {})}
        if self._tracing:
            self._trace.append(Commanded(now, "revoke", request))
        self._told_at = None
        self._tell(now)
        return True

    def _tell(self, now: float) -> None:
        """Somebody may not know of the newest revocation."""
        if self._told_at is None or now >= self._told_at + TOLD_AGAIN_S:
            self._tells, self._told_at = True, now

    # Brown-outs

    def secured_state(self) -> SecuredState:
        """What it keeps on its vehicle's disk beside what every agent does."""
        revocation = None if self.revocation is None else self.revocation.encode()
        return SecuredState(self.started_us, dict(self.signatures), revocation)

    @property
    def started_us(self) -> int:
        """When this life began, in microseconds UTC, as others are told."""
        (started_us,) = _BOOT_TIME.unpack_from(self.session.boot)
        return int(started_us)

    def boot(self, recovered: StoredState, now: float) -> None:
        """Go on from the store; this life is a later one than those before, whatever the clock says by now."""
        secured = recovered.secured
        if secured is not None:
            self._signatures.restore(secured.signatures)
            if self.started_us <= secured.started_us:
                self.session.boot = boot_of(secured.started_us + 1, self.session.boot[_BOOT_TIME.size :])
            if secured.revocation is not None:
                with suppress(RevocationError):  # of keys that it had before
                    self.revocation = Revocation.decode(
                        secured.revocation, self.session.authority, self.session.mission
                    )
        super().boot(recovered, now)
