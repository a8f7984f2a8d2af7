"""An agent of a secured mission. It has the interface of `Agent`, and seals and opens its datagrams. The handlers of
the protocol do not change. They receive a message only if the message is authentic and fresh, and its sender is not
revoked. If the message carries a block, the agent that completed the block must have signed it. If the message is a
response, it must answer the newest known request of its type. A new revocation is stored and forwarded. All other
datagrams are counted in `dropped` and change no state of the agent.

The trace contains datagrams in their plain form, so the harness reads and judges it like any other trace. Only dropped
datagrams are recorded as they were received.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ucp.agent import Agent, drop_reason
from ucp.export import export_chain
from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.secure._known_revocations import KnownRevocations
from ucp.secure._signatures import BlockSignatures
from ucp.secure.envelope import BOOT_BYTES, CHALLENGE, LAST_SEQUENCE, REQUESTS, REVOCATION, ClearHeader
from ucp.secure.export_head import head_of
from ucp.secure.revocation import RevocationError
from ucp.secure.sealed_datagrams import AnsweredRequest, OpenedDatagram
from ucp.secure.session import Session
from ucp.store import SecuredState, StoredState
from ucp.trace import CommandEntry, RecordedBytes, in_base64

REVOCATION_INTERVAL_S = 5.0
"""Minimum time in mission seconds between two broadcasts of a revocation."""
_BOOT_TIME = struct.Struct("!Q")


class OutgoingDatagram(NamedTuple):
    """A datagram to broadcast, with its message in plain form. A revocation has no message."""

    sealed: bytes
    sequence: int = 0
    message: Message | None = None
    plain: RecordedBytes | None = None


def make_boot(started_us: int, random_bytes: bytes) -> bytes:
    """Return the value that identifies a start of an agent in its datagrams: the start time in microseconds UTC, and 8
    random bytes.
    """
    boot = _BOOT_TIME.pack(started_us) + random_bytes
    assert len(boot) == BOOT_BYTES
    return boot


class SecuredAgent(Agent):
    """An agent that encrypts, decrypts and signs its datagrams with a session. The other arguments are those of
    `Agent`.

    Raises ValueError if the session belongs to another agent, or lacks the public key of an agent on the roster.
    """

    def __init__(self, session: Session, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        if session.agent_id != self.agent_id:
            raise ValueError(f"the session belongs to agent {session.agent_id}, not to agent {self.agent_id}")
        if missing := sorted(self.roster - session.public_keys.keys()):
            raise ValueError(f"the session has no public keys of the agents {missing}")
        self.session = session
        self._revocations = KnownRevocations(session.authority, session.mission)
        self.problem: str | None = None
        """The reason why the agent has stopped sending. None while it sends."""
        self._signatures = BlockSignatures(session, self.state)
        self._answered_requests: dict[int, AnsweredRequest] = {}
        """Sequence number of a response that waits to be sent -> the request that it answers."""
        self._exports = 0
        self._now = 0.0
        """Mission second of the last datagram or revocation that the agent received."""
        self._revocation_due = False
        self._revocation_sent_at: float | None = None

    @property
    def signatures(self) -> Mapping[bytes, bytes]:
        """The signatures of all blocks that the agent holds, by block hash. Each signature is by the agent that
        completed the block.
        """
        return self._signatures.held()

    def signed_export(self, exported_at_us: int) -> dict[str, object]:
        """Return the chain export with the signatures of the blocks and a signed head."""
        return {**export_chain(self.state, exported_at_us, self.signatures), "head": self.sign_head(exported_at_us)}

    def sign_head(self, exported_at_us: int) -> dict[str, object]:
        """Return the signed head of a chain export. Each head has the next higher number."""
        self._exports += 1
        head = head_of(self.state, self.session.boot, self._exports, exported_at_us, self.revoked)
        return head.sign(self.session.private_key, self.session.mission)

    # From the air

    def receive_datagram(self, data: bytes, now: float) -> None:
        self.session.set_clock(now)
        self._now = now
        try:
            clear = self.session.crypto.read(data)
            if reason := self._drop_reason(clear):
                raise MalformedDatagramError(reason)
            if clear.type >= REVOCATION:
                self._receive_control(data, clear, now)
                return
            opened = self.session.open(data, clear, now)
            if clear.revocations != self._revocations.digest:
                self._schedule_revocations(now)
            self._check_opened(opened)
        except MalformedDatagramError as malformed:
            self._drop(now, malformed.reason, RecordedBytes(in_base64(data)))
            return
        self._handle_opened(opened, now)

    def _receive_control(self, data: bytes, clear: ClearHeader, now: float) -> None:
        """Handle a control datagram, which contains no message of the protocol. Raises MalformedDatagramError."""
        if clear.type == REVOCATION:
            self._receive_revocation(self.session.open_revocation(data, clear, now), clear.sender, now)
            return
        if clear.type == CHALLENGE:
            self.session.receive_challenge(data, clear, now)
            self._revocation_sent_at = None  # the sender waits for revocations before it trusts others
        else:
            self.session.receive_echo(data, clear, now)
        if clear.revocations != self._revocations.digest:
            self._schedule_revocations(now)

    def _drop_reason(self, clear: ClearHeader) -> str | None:
        if clear.sender == self.agent_id:
            return "own sender"
        if clear.sender not in self.roster:
            return "sender not on the roster"
        if clear.type != REVOCATION and clear.sender in self.revoked:
            return "revoked sender"
        return None

    def _check_opened(self, opened: OpenedDatagram) -> None:
        """Raise MalformedDatagramError if this authentic message must not reach a handler."""
        sender, _, message = opened.datagram
        if reason := drop_reason(self.agent_id, self.roster, sender, message):
            raise MalformedDatagramError(reason)
        if opened.request is not None and not self.session.is_newest_request(opened.request, opened.clear.type):
            raise MalformedDatagramError("answers no request")
        if type(message) in CARRY_A_BLOCK and not self._signatures.is_genuine(message.block, opened.block_signature):  # type: ignore[union-attr]
            self.session.count_wrong_signature(sender)
            raise MalformedDatagramError("block not signed by its maker")

    def _handle_opened(self, opened: OpenedDatagram, now: float) -> None:
        clear, (sender, sequence, message) = opened.clear, opened.datagram
        outbox_length = len(self._core.outbox)
        super().receive_message(sender, sequence, message, now, opened.recorded)
        if clear.type in REQUESTS:
            request = AnsweredRequest(sender, clear.boot, sequence)
            self._answered_requests.update((answer, request) for answer, _, _ in self._core.outbox[outbox_length:])
        if type(message) in CARRY_A_BLOCK:
            self._signatures.forget_unless_held(message.block)  # type: ignore[union-attr]

    # To the air

    def datagrams_to_send(self) -> list[bytes]:
        return [outgoing.sealed for outgoing in self.sealed_to_send()]

    def sealed_to_send(self) -> Sequence[OutgoingDatagram]:
        """Return the datagrams to broadcast now, in order. The setting `answer_spread_s` delays the answers among
        them.
        """
        due = self._due_to_send()
        if not (due or self._revocation_due or self.session.has_control_datagrams):
            return ()
        now = self.state.now if due else self._now
        self.session.set_clock(now)
        outgoing = []
        if self._revocation_due:
            self._revocation_due = False
            digest = self._revocations.digest
            outgoing += [
                OutgoingDatagram(self.session.seal_revocation(body, digest)) for body in self._revocations.bodies
            ]
        outgoing += map(OutgoingDatagram, self.session.control_datagrams(self._revocations.digest, now))
        for sequence, message, plain in due:
            if sequence > LAST_SEQUENCE:
                self.problem = "the agent has used all sequence numbers of this boot: restart it so that it sends again"
                continue
            signature = self.signatures.get(message.block.block_hash) if type(message) in CARRY_A_BLOCK else None  # type: ignore[union-attr]
            request = self._answered_requests.pop(sequence, None)
            sealed = self.session.seal(sequence, message, request, signature, self._revocations.digest)
            outgoing.append(OutgoingDatagram(sealed, sequence, message, plain))
        return outgoing

    # Revocations

    @property
    def revoked(self) -> frozenset[int]:
        """All agents that a known revocation lists."""
        return self._revocations.revoked

    def _receive_revocation(self, body: bytes, sender: int, now: float) -> None:
        """Accept the body of a revocation that another vehicle has sent. Raises MalformedDatagramError."""
        if self._revocations.adds_nothing(body):
            raise MalformedDatagramError("known already")
        budget = self.session.revocation_budget
        if not budget.has_token(now):
            raise MalformedDatagramError("too many wrong signatures")
        try:
            self.revoke(body, now, {"from": sender})
        except MalformedDatagramError:
            budget.take()
            raise

    def revoke(self, body: bytes, now: float, origin: Mapping[str, Any] | None = None) -> None:
        """Accept the body of a revocation. A body that lists no newly revoked agent has no effect.

        `origin` is written to the trace. Raises MalformedDatagramError if the authority did not sign the revocation.
        """
        try:
            is_new = self._revocations.add(body)
        except RevocationError:
            raise MalformedDatagramError("not signed by the authority") from None
        if not is_new:
            return
        self._now = now
        request = {"command": "revoke", "revocation": in_base64(body), **(origin or {})}
        if self._tracing:
            self._trace.append(CommandEntry(now, "revoke", request))
        self._revocation_sent_at = None
        self._schedule_revocations(now)

    def _schedule_revocations(self, now: float) -> None:
        """Broadcast the known revocations together with the next datagrams, at most once per REVOCATION_INTERVAL_S."""
        if not self.revoked:
            return
        if self._revocation_sent_at is None or now >= self._revocation_sent_at + REVOCATION_INTERVAL_S:
            self._revocation_due, self._revocation_sent_at = True, now

    # Brown-outs

    def secured_state(self) -> SecuredState:
        """Return the state that a secured agent stores on disk in addition to the state of every agent."""
        return SecuredState(self.started_us, dict(self.signatures), self._revocations.bodies)

    @property
    def started_us(self) -> int:
        """The time at which this incarnation started, in microseconds since the Unix epoch (UTC). Its datagrams contain
        this time.
        """
        (started_us,) = _BOOT_TIME.unpack_from(self.session.boot)
        return int(started_us)

    def boot(self, recovered: StoredState, now: float) -> None:
        """Continue from the data stored on disk. The new start time is later than the stored one, even if the clock was
        set back.
        """
        secured = recovered.secured
        if secured is not None:
            self._signatures.restore(secured.signatures)
            if self.started_us <= secured.started_us:
                self.session.boot = make_boot(secured.started_us + 1, self.session.boot[_BOOT_TIME.size :])
            self._revocations.restore(secured.revocations)
        super().boot(recovered, now)
