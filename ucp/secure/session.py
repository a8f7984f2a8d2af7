"""Seal and open the datagrams of one incarnation of a vehicle.

The construction follows Group OSCORE (RFC 10021). The sender signs the datagram, derives its own key from the group
secret, and encrypts and authenticates datagram and signature with it (AEAD). Because of the signature, a vehicle with
the group secret cannot send in the name of another vehicle. Because the encryption covers the signature, a sender
without the group secret cannot make a receiver verify one. Each datagram contains all data that a receiver needs, so
there are no round trips.

A receiver does its cheapest checks first. A datagram changes no state of the session before its signature is verified.
"""

from collections.abc import Callable

from ucp.messages import TYPE_CODES, MalformedDatagramError, Message
from ucp.secure._budget import Budget
from ucp.secure._epochs import Epochs
from ucp.secure._window import ReplayWindow
from ucp.secure.bundle import Bundle
from ucp.secure.crypto_suite import SenderKeys
from ucp.secure.envelope import (
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
    CryptoFunctions,
    OpenedDatagram,
    Request,
    decrypted,
    signing_domain,
)

WRONG_SIGNATURES_PER_S = 1000.0
"""Wrong signatures of senders that a receiver verifies in a mission second, about a tenth of a processor core."""
REVOCATIONS_PER_S = 50.0
"""Wrong signatures of the authority that a receiver verifies in a mission second."""


class _Incarnation:
    """The newest known incarnation of another sender, with its accepted sequence numbers and its newest requests."""

    __slots__ = ("boot", "requests", "window")

    def __init__(self, boot: bytes) -> None:
        self.boot = boot
        self.window = ReplayWindow()
        self.requests: dict[int, int] = {}
        """Type of a request -> sequence of the newest request of this type that was received."""


class Session:
    """The session of one incarnation of a vehicle.

    `boot` consists of the incarnation's start in microseconds UTC (8 bytes) and 8 random bytes. `save_bundle` is called
    with the new bundle after each change of the epoch.
    """

    def __init__(
        self,
        bundle: Bundle,
        boot: bytes,
        save_bundle: Callable[[Bundle], None] = lambda _: None,
        crypto: CryptoFunctions = CRYPTO_FUNCTIONS,
    ) -> None:
        self.agent_id = bundle.agent_id
        self.boot = boot
        self.mission = bundle.public.mission
        self.authority = bundle.public.authority
        self.public_keys = bundle.public.vehicles
        self.crypto = crypto
        self.private_key = crypto.signer(bundle.private_key)
        self.epochs = Epochs(bundle, save_bundle, crypto.sender_keys)
        self._domain = signing_domain(self.mission)
        self._incarnations: dict[int, _Incarnation] = {}
        self._control = 0
        """Sequence of the next control datagram."""
        per_s = WRONG_SIGNATURES_PER_S / len(self.public_keys)
        self._budgets = {agent_id: Budget(per_s) for agent_id in self.public_keys}
        self.revocation_budget = Budget(REVOCATIONS_PER_S)
        self._own_requests: dict[int, int] = {}
        """Type of a request -> sequence of this vehicle's newest request of this type."""

    # To the air

    def seal(
        self, sequence: int, message: Message, request: Request | None, block_signature: bytes | None, revocations: int
    ) -> bytes:
        """Return the sealed datagram of a message. The caller must use each sequence once, up to LAST_SEQUENCE."""
        self.record_sent(sequence, message)
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
        """Return the sealed datagram of a revocation."""
        header = ClearHeader(REVOCATION, self.agent_id, self._control, self.epochs.current, self.boot, revocations)
        self._control += 1
        clear = header.pack(len(body) + TAG_BYTES)
        return clear + self._own_keys().encrypt(header.position, body, clear)

    def _own_keys(self) -> SenderKeys:
        epoch = self.epochs.current
        keys = self.epochs.sender_keys(epoch, self.agent_id, self.boot)
        self.epochs.remember(epoch, self.agent_id, self.boot, keys)
        return keys

    # From the air

    def open(self, datagram: bytes, clear: ClearHeader, now: float) -> OpenedDatagram:
        """Return the content of a datagram with this header, received at mission second `now`.

        The sender must be another vehicle of the mission.

        Raises MalformedDatagramError.
        """
        incarnation = self._incarnations.get(clear.sender)
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        if incarnation is not None and clear.boot < incarnation.boot:
            raise MalformedDatagramError("old boot")
        if (
            incarnation is not None
            and clear.boot == incarnation.boot
            and not incarnation.window.is_fresh(clear.sequence)
        ):
            raise MalformedDatagramError("replayed")
        body = self._authenticate(datagram, clear, now)
        if incarnation is None or clear.boot != incarnation.boot:
            incarnation = self._incarnations[clear.sender] = _Incarnation(clear.boot)
        incarnation.window.accept(clear.sequence)
        if clear.epoch > self.epochs.current:
            self.epochs.advance_to(clear.epoch)
        if clear.type in REQUESTS:
            incarnation.requests[clear.type] = max(clear.sequence, incarnation.requests.get(clear.type, 0))
        return self.crypto.parse_body(clear, body)

    def open_revocation(self, datagram: bytes, clear: ClearHeader) -> bytes:
        """Return the body of a revocation. Raises MalformedDatagramError.

        The sender need not be authentic. The caller verifies the signature of the authority.
        """
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        return decrypted(self.epochs.sender_keys(clear.epoch, clear.sender, clear.boot), datagram, clear)

    def _authenticate(self, datagram: bytes, clear: ClearHeader, now: float) -> bytes:
        """Return the decrypted body. Raises MalformedDatagramError if decryption or the signature fails."""
        keys = self.epochs.sender_keys(clear.epoch, clear.sender, clear.boot)
        body, claim = self.crypto.decrypt(keys, datagram, clear, self._domain, self.public_keys[clear.sender])
        if not self._budgets[clear.sender].has_token(now):
            raise MalformedDatagramError("too many wrong signatures")
        if not self.crypto.verify(claim):
            self.count_wrong_signature(clear.sender)
            raise MalformedDatagramError("not signed by its sender")
        self.epochs.remember(clear.epoch, clear.sender, clear.boot, keys)
        return body

    def count_wrong_signature(self, sender: int) -> None:
        """Take a token for a wrong signature from the budget of the sender."""
        self._budgets[sender].take()

    def is_newest_request(self, request: Request, code: int) -> bool:
        """Return whether a response of type `code` counts: no newer request of its type by the same sender is known.

        If this vehicle sent the request, it must be its newest. A request of another vehicle need not have been
        received.
        """
        request_type = REQUEST_OF[code]
        if request.sender == self.agent_id:
            return request.boot == self.boot and request.sequence == self._own_requests.get(request_type)
        if request.sender not in self.public_keys:
            return False
        incarnation = self._incarnations.get(request.sender)
        if incarnation is None or request.boot > incarnation.boot:
            return True
        return request.boot == incarnation.boot and request.sequence >= incarnation.requests.get(request_type, 0)
