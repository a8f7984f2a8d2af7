"""Seal and open the datagrams of one incarnation of a vehicle.

The construction follows Group OSCORE (RFC 10021). The sender signs the datagram, and derives a key of its own from the
group secret. With this key it encrypts and authenticates the datagram and the signature (AEAD). Because of the
signature, a vehicle with the group secret cannot send in the name of another vehicle. Because the encryption covers the
signature, a sender without the group secret cannot make a receiver verify one. Each datagram contains all data that a
receiver needs, so there are no round trips.

A receiver does its cheapest checks first. A datagram changes no state of the session before its signature is verified.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from ucp.messages import TYPE_CODES, MalformedDatagramError, Message
from ucp.secure._budget import TokenBudget
from ucp.secure._challenges import ALL, TRUST_DELAY_S, PendingChallenges, ReceivedChallenges
from ucp.secure._epochs import EpochSecrets
from ucp.secure._window import ReplayWindow
from ucp.secure.bundle import LAST_START_US, Bundle
from ucp.secure.crypto_suite import SenderKeys, UnverifiedSignature
from ucp.secure.envelope import (
    CHALLENGE,
    ECHO,
    LAST_SEQUENCE,
    REQUEST,
    REQUEST_OF,
    REQUESTS,
    REVOCATION,
    SEAL_BYTES,
    SIGNATURE_BYTES,
    TAG_BYTES,
    WITH_BLOCK,
    ClearHeader,
)
from ucp.secure.sealed_datagrams import (
    CRYPTO_FUNCTIONS,
    NO_REQUEST,
    AnsweredRequest,
    CryptoFunctions,
    OpenedDatagram,
    decrypted,
    signing_domain,
)

WRONG_SIGNATURES_PER_S = 1000.0
"""Maximum number of wrong signatures that a receiver verifies per mission second. The senders share this number
equally. The verification takes a tenth of a processor core.
"""
REVOCATIONS_PER_S = 50.0
"""Maximum number of wrong signatures of the authority that a receiver verifies per mission second."""
WRONG_SIGNATURES_AT_ONCE = 32
"""Maximum number of wrong signatures in one sender's name that a receiver verifies immediately one after another."""
UNKNOWN_BOOTS_PER_S = 5000.0
"""Maximum number of datagrams per mission second from unknown starts (boots) of senders for which a receiver derives
keys. A radio with 6 Mbit/s carries fewer datagrams. The derivation takes a twentieth of a processor core.
"""
UNKNOWN_BOOTS_AT_ONCE = 1000
"""Maximum number of keys for unknown starts (boots) that a receiver derives immediately one after another."""


class _SenderIncarnation:
    """The last known start of another sender, with the sequence numbers that were accepted since then, and the newest
    requests.
    """

    __slots__ = ("boot", "latest_boot", "requests", "window")

    def __init__(self, boot: bytes, first: int = 0, latest_boot: bytes = b"") -> None:
        self.boot = boot
        self.latest_boot = max(boot, latest_boot)
        """The latest start (boot) of this sender so far. It is later than `boot` if the sender has lost its clock."""
        self.window = ReplayWindow(first)
        self.requests: dict[int, int] = {}
        """Type of a request -> sequence of the newest request of this type that was received."""

    def is_later(self, boot: bytes) -> bool:
        """Return whether a start with this `boot` is later than all known starts of the sender."""
        return boot > self.latest_boot


class Session:
    """The keys and counters with which one incarnation of a vehicle seals and opens datagrams.

    `boot` consists of the incarnation's start in microseconds UTC (8 bytes) and 8 random bytes. `save_bundle` is called
    with the new bundle immediately, so that a later incarnation can detect this incarnation. It is called again after
    each change of the epoch. If `has_budgets` is false, the number of wrong signatures and of unknown boots has no
    limit.
    """

    def __init__(
        self,
        bundle: Bundle,
        boot: bytes,
        save_bundle: Callable[[Bundle], None] = lambda _: None,
        crypto: CryptoFunctions = CRYPTO_FUNCTIONS,
        has_budgets: bool = True,
    ) -> None:
        self.agent_id = bundle.agent_id
        self.boot = boot
        self.mission = bundle.public.mission
        self.authority = bundle.public.authority
        self.public_keys = bundle.public.vehicles
        self.crypto = crypto
        self.private_key = crypto.signer(bundle.private_key)
        self._is_first = bundle.started_us is None
        started = replace(bundle, started_us=int.from_bytes(boot[:8], "big") % LAST_START_US)
        save_bundle(started)
        self.epochs = EpochSecrets(started, save_bundle, crypto.sender_keys)
        self.challenges = PendingChallenges()
        self._is_complete: bool | None = None
        """True if this vehicle has listened since the beginning of the mission, because no earlier start used the
        bundle. Its replay windows then cover the whole mission, so it recognises every repeated datagram. None before
        the start.
        """
        self._held: dict[int, _SenderIncarnation] = {}
        """Sender -> its last known start. These senders have answered a challenge, but this vehicle does not trust them
        yet, because it still collects answers.
        """
        self._challenged_by = {agent_id: ReceivedChallenges() for agent_id in self.public_keys}
        self._echoes: list[AnsweredRequest] = []
        """The received challenges that this vehicle still has to answer."""
        self._next_sequence = 0
        """The sequence number after the greatest one that this vehicle has used."""
        self._domain = signing_domain(self.mission)
        self._incarnations: dict[int, _SenderIncarnation] = {}
        self._control = 0
        """Sequence of the next control datagram."""
        scale = 1.0 if has_budgets else math.inf
        per_sender_s = scale * WRONG_SIGNATURES_PER_S / len(self.public_keys)
        self._budgets = {agent_id: TokenBudget(per_sender_s, WRONG_SIGNATURES_AT_ONCE) for agent_id in self.public_keys}
        self.revocation_budget = TokenBudget(scale * REVOCATIONS_PER_S, WRONG_SIGNATURES_AT_ONCE)
        self._boot_budget = TokenBudget(scale * UNKNOWN_BOOTS_PER_S, UNKNOWN_BOOTS_AT_ONCE)
        self._own_requests: dict[int, int] = {}
        """Type of a request -> sequence number of this vehicle's newest request of this type."""

    def set_clock(self, now: float) -> None:
        """Set the clock to mission second `now`. The first call is at the start of the incarnation.

        The replay windows are complete if no earlier incarnation used the bundle, and the mission has just begun.
        """
        self.epochs.set_clock(now)
        if self._is_complete is None:
            self._is_complete = self._is_first and abs(now) < self.epochs.bundle.public.epoch_s

    # To the air

    def seal(
        self,
        sequence: int,
        message: Message,
        request: AnsweredRequest | None,
        block_signature: bytes | None,
        revocations: int,
    ) -> bytes:
        """Return a message as an encrypted datagram. Each sequence number up to LAST_SEQUENCE may be used once."""
        self.record_sent(sequence, message)
        self._next_sequence = max(self._next_sequence, sequence + 1)
        code = TYPE_CODES[type(message)]
        body = message.body()
        if code in REQUEST_OF:
            body = REQUEST.pack(*(request or NO_REQUEST)) + body
        if code in WITH_BLOCK:
            body += block_signature or bytes(SIGNATURE_BYTES)
        epoch = self.epochs.current
        assert 0 <= sequence <= LAST_SEQUENCE, "a nonce is used once"
        clear = ClearHeader(code, self.agent_id, sequence, epoch, self.boot, revocations).pack(len(body) + SEAL_BYTES)
        signature = self.private_key.sign(self._domain + clear + body)
        return clear + self._own_keys().encrypt(sequence, body + signature, clear)

    def record_sent(self, sequence: int, message: Message) -> None:
        """Record a sent message. If it is a request, answers to earlier requests of its type no longer count."""
        code = TYPE_CODES[type(message)]
        if code in REQUESTS:
            self._own_requests[code] = sequence

    def seal_revocation(self, body: bytes, revocations: int) -> bytes:
        """Return a revocation as an encrypted datagram."""
        return self._seal_control(REVOCATION, body, revocations)

    @property
    def has_control_datagrams(self) -> bool:
        """True if the vehicle has a challenge or an echo to send."""
        return bool(self._echoes) or self.challenges.is_due

    def control_datagrams(self, revocations: int, now: float) -> Iterator[bytes]:
        """Yield the challenges and echoes to broadcast now."""
        if not self._is_complete and self.challenges.first_at is None:
            self.challenges.ask(ALL, now)
        for target in self.challenges.take_due(now):
            self.challenges.sent(target, self._control)
            yield self._seal_control(CHALLENGE, target.to_bytes(4, "big"), revocations)
        echoes, self._echoes = self._echoes, []
        for request in echoes:
            body = REQUEST.pack(*request) + self._next_sequence.to_bytes(4, "big")
            yield self._seal_control(ECHO, body, revocations)

    def _seal_control(self, code: int, body: bytes, revocations: int) -> bytes:
        header = ClearHeader(code, self.agent_id, self._control, self.epochs.current, self.boot, revocations)
        self._control += 1
        length = len(body) + (TAG_BYTES if code == REVOCATION else SEAL_BYTES)
        clear = header.pack(length)
        signature = b"" if code == REVOCATION else self.private_key.sign(self._domain + clear + body)
        return clear + self._own_keys().encrypt(header.position, body + signature, clear)

    def _own_keys(self) -> SenderKeys:
        own = self.epochs.current, self.agent_id, self.boot
        keys = self.epochs.cached_keys(*own)
        if keys is None:
            keys = self.epochs.derive_keys(*own)
            self.epochs.remember(*own, keys)
        return keys

    # From the air

    def open(self, datagram: bytes, clear: ClearHeader, now: float) -> OpenedDatagram:
        """Decrypt and check a datagram with this header, and return its content. `now` is the mission second of its
        arrival.

        The sender must be another vehicle of the mission.

        Raises MalformedDatagramError.
        """
        if self._is_complete is None:
            self.set_clock(now)
        if self._held:
            self._trust_held(now)
        incarnation = self._incarnations.get(clear.sender)
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        if incarnation is None and not self._is_complete:
            self._decrypt(datagram, clear, now)
            self.epochs.follow(clear.epoch)
            self.challenges.ask(ALL, now)
            raise MalformedDatagramError("not confirmed")
        if incarnation is not None and clear.boot != incarnation.boot and not incarnation.is_later(clear.boot):
            self._decrypt(datagram, clear, now)
            self.challenges.ask(clear.sender, now)
            raise MalformedDatagramError("old boot")
        if (
            incarnation is not None
            and clear.boot == incarnation.boot
            and not incarnation.window.is_fresh(clear.sequence)
        ):
            raise MalformedDatagramError("replayed")
        body = self._authenticate(datagram, clear, now)
        if incarnation is None or clear.boot != incarnation.boot:
            incarnation = self._accept_boot(clear)
        incarnation.window.accept(clear.sequence)
        self.epochs.follow(clear.epoch)
        if clear.type in REQUESTS:
            incarnation.requests[clear.type] = max(clear.sequence, incarnation.requests.get(clear.type, 0))
        return self.crypto.parse_body(clear, body)

    def open_revocation(self, datagram: bytes, clear: ClearHeader, now: float) -> bytes:
        """Decrypt a revocation and return its body. Raises MalformedDatagramError.

        The sender need not be authentic. The caller verifies the signature of the authority.
        """
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        return decrypted(self._keys_of(clear, now), datagram, clear)

    def _accept_boot(self, clear: ClearHeader) -> _SenderIncarnation:
        """Accept a new start of the sender. It must be later than all known starts of this sender. Echoes to earlier
        challenges no longer count.
        """
        self.challenges.close(clear.sender, self._control)
        incarnation = self._incarnations[clear.sender] = _SenderIncarnation(clear.boot)
        return incarnation

    def receive_challenge(self, datagram: bytes, clear: ClearHeader, now: float) -> None:
        """Schedule an echo that answers a challenge. Raises MalformedDatagramError.

        The method drops a challenge that is not newer than all known challenges of its boot. Such a challenge may be a
        replay, and the sender of the original challenge no longer waits for an answer.
        """
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        received = self._challenged_by[clear.sender]
        if not received.is_new(clear.boot, clear.sequence):
            raise MalformedDatagramError("replayed")
        body = self._authenticate(datagram, clear, now)
        if len(body) != 4:
            raise MalformedDatagramError("wrong length")
        received.add(clear.boot, clear.sequence)
        incarnation = self._incarnations.get(clear.sender)
        if self._is_complete if incarnation is None else incarnation.is_later(clear.boot):
            self._accept_boot(clear)
        self.epochs.follow(clear.epoch)
        if int.from_bytes(body, "big") in (ALL, self.agent_id):
            self._echoes.append(AnsweredRequest(clear.sender, clear.boot, clear.sequence))

    def receive_echo(self, datagram: bytes, clear: ClearHeader, now: float) -> None:
        """Accept the sender of an echo, if it answers a challenge of this vehicle. Raises MalformedDatagramError."""
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        _, body, _ = self._decrypt(datagram, clear, now)
        if len(body) != REQUEST.size + 4:
            raise MalformedDatagramError("wrong length")
        request = AnsweredRequest(*REQUEST.unpack_from(body))
        is_own = (request.sender, request.boot) == (self.agent_id, self.boot)
        if not is_own or not self.challenges.is_pending(request.sequence, clear.sender):
            raise MalformedDatagramError("answers no request")
        self._authenticate(datagram, clear, now)
        self.challenges.close(clear.sender, self._control)
        self.epochs.follow(clear.epoch)
        known = self._incarnations.get(clear.sender)
        if known is None or known.boot != clear.boot:
            first, latest_boot = int.from_bytes(body[REQUEST.size :], "big"), known.latest_boot if known else b""
            self._held[clear.sender] = _SenderIncarnation(clear.boot, first, latest_boot)
            self._trust_held(now)

    def _trust_held(self, now: float) -> None:
        """Accept the senders that have answered a challenge. Do nothing while this vehicle still collects echoes."""
        first_at = self.challenges.first_at
        answered = len(self._held.keys() | self._incarnations.keys())
        collects = not self._is_complete and first_at is not None and now < first_at + TRUST_DELAY_S
        if not collects or answered == len(self.public_keys) - 1:
            self._incarnations |= self._held
            self._held.clear()

    def _keys_of(self, clear: ClearHeader, now: float) -> SenderKeys:
        """Return the keys that seal the datagram with this header. Raises MalformedDatagramError if the budget for
        unknown boots has no token left.

        The keys of an accepted boot in the present epochs need no token. They are kept, so that an attacker cannot make
        the receiver derive them again.
        """
        sealed_by = clear.epoch, clear.sender, clear.boot
        keys = self.epochs.cached_keys(*sealed_by)
        if keys is not None:
            return keys
        incarnation = self._incarnations.get(clear.sender)
        if incarnation is not None and clear.boot == incarnation.boot and self.epochs.is_near(clear.epoch):
            keys = self.epochs.derive_keys(*sealed_by)
            self.epochs.remember(*sealed_by, keys)
            return keys
        if not self._boot_budget.has_token(now):
            raise MalformedDatagramError("too many unknown boots")
        self._boot_budget.take()
        return self.epochs.derive_keys(*sealed_by)

    def _decrypt(
        self, datagram: bytes, clear: ClearHeader, now: float
    ) -> tuple[SenderKeys, bytes, UnverifiedSignature]:
        """Return keys, body and unverified signature of a datagram.

        Raises MalformedDatagramError if the tag is wrong, or if the budget has no token to derive the keys.
        """
        keys = self._keys_of(clear, now)
        return keys, *self.crypto.decrypt(keys, datagram, clear, self._domain, self.public_keys[clear.sender])

    def _authenticate(self, datagram: bytes, clear: ClearHeader, now: float) -> bytes:
        """Return the decrypted body. Raises MalformedDatagramError if decryption or the signature fails."""
        keys, body, claim = self._decrypt(datagram, clear, now)
        if not self._budgets[clear.sender].has_token(now):
            raise MalformedDatagramError("too many wrong signatures")
        if not self.crypto.verify(claim):
            self.count_wrong_signature(clear.sender)
            raise MalformedDatagramError("not signed by its sender")
        self.epochs.remember(clear.epoch, clear.sender, clear.boot, keys)
        return body

    def count_wrong_signature(self, sender: int) -> None:
        """Take a token from the budget of this sender, because a signature in its name was wrong."""
        self._budgets[sender].take()

    def is_newest_request(self, request: AnsweredRequest, code: int) -> bool:
        """Return true if a response of type `code` to this request counts. The response does not count if a newer
        request of the same type and sender is known.

        If this vehicle sent the request, it must be the newest request of this vehicle. If another vehicle sent the
        request, this vehicle need not have received it.
        """
        request_type = REQUEST_OF[code]
        if request.sender == self.agent_id:
            return request.boot == self.boot and request.sequence == self._own_requests.get(request_type)
        if request.sender not in self.public_keys:
            return False
        incarnation = self._incarnations.get(request.sender)
        if incarnation is None or incarnation.is_later(request.boot):
            return True
        return request.boot == incarnation.boot and request.sequence >= incarnation.requests.get(request_type, 0)
