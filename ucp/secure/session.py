"""What one vehicle needs in one life to send datagrams that are authentic, confidential and fresh, and to open them.

The construction is that of Group OSCORE (RFC 10021): an AEAD under a key of the sender's own, derived from the group's
secret, and over that the sender's signature, so that who holds the group's secret does not speak for others. There are
no round trips: everything that a receiver needs is in the datagram.

Checks stand in the order of what they cost, the cheapest first; nothing changes before a datagram has passed them up to
its signature.
"""

from collections.abc import Callable

from ucp.messages import TYPE_CODES, MalformedDatagramError, Message
from ucp.secure._epochs import Epochs
from ucp.secure._window import ReplayWindow
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import (
    LAST_SEQUENCE,
    REQUEST,
    REQUEST_OF,
    REQUESTS,
    REVOCATION,
    SEAL_BYTES,
    SIGNATURE_BYTES,
    WITH_BLOCK,
    Clear,
)
from ucp.secure.sealed_datagrams import ARITHMETIC, NOTHING_ASKED, Arithmetic, Opened, Request, domain_of


class _Life:
    """Of another sender: the newest of its lives that was heard, and what of it."""

    __slots__ = ("boot", "requests", "window")

    def __init__(self, boot: bytes) -> None:
        self.boot = boot
        self.window = ReplayWindow()
        self.requests: dict[int, int] = {}
        """Type of a request -> sequence of the newest that was heard."""


class Session:
    """One vehicle's life. `boot` is when it began, in microseconds UTC (8 bytes), and 8 bytes of chance.

    `keep` is given the bundle whenever old secrets are gone from it.
    """

    def __init__(
        self,
        bundle: Bundle,
        boot: bytes,
        keep: Callable[[Bundle], None] = lambda _: None,
        arithmetic: Arithmetic = ARITHMETIC,
    ) -> None:
        self.agent_id = bundle.agent_id
        self.boot = boot
        self.mission = bundle.public.mission
        self.authority = bundle.public.authority
        self.public_keys = bundle.public.vehicles
        self.arithmetic = arithmetic
        self.private_key = arithmetic.signer(bundle.private_key)
        self.epochs = Epochs(bundle, keep, arithmetic.sender_keys)
        self._domain = domain_of(self.mission)
        self._lives: dict[int, _Life] = {}
        self._asked: dict[int, int] = {}
        """Type of a request -> sequence of the newest of its own."""

    # To the air

    def seal(
        self, sequence: int, message: Message, request: Request | None, block_signature: bytes | None, revocations: int
    ) -> bytes:
        """The datagram of a message. Each sequence, at most LAST_SEQUENCE, is used once."""
        self.asks(sequence, message)
        code = TYPE_CODES[type(message)]
        body = message.body()
        if code in REQUEST_OF:
            body = REQUEST.pack(*(request or NOTHING_ASKED)) + body
        if code in WITH_BLOCK:
            body += block_signature or bytes(SIGNATURE_BYTES)
        epoch = self.epochs.current
        assert 0 <= sequence <= LAST_SEQUENCE, "a nonce is used once"
        clear = Clear(code, self.agent_id, sequence, epoch, self.boot, revocations).pack(len(body) + SEAL_BYTES)
        keys = self.epochs.keys_of(epoch, self.agent_id, self.boot)
        self.epochs.remember(epoch, self.agent_id, self.boot, keys)
        ciphertext = keys.encrypt(sequence, body, clear)
        signature = self.private_key.sign(self._domain + clear + ciphertext)
        return clear + ciphertext + keys.masked(sequence, signature)

    def asks(self, sequence: int, message: Message) -> None:
        """It sends a message: if that asks something, answers to what it asked of the kind before no longer count."""
        code = TYPE_CODES[type(message)]
        if code in REQUESTS:
            self._asked[code] = sequence

    def tell(self, number: int, revocation: bytes) -> bytes:
        """The datagram of a revocation with this number: whoever knows the authority can read it."""
        clear = Clear(REVOCATION, self.agent_id, 0, self.epochs.current, self.boot, number)
        return clear.pack(len(revocation)) + revocation

    # From the air

    def open(self, datagram: bytes, clear: Clear) -> Opened:
        """What a datagram with this header says; its sender is another vehicle of the mission.

        Raises MalformedDatagramError.
        """
        life = self._lives.get(clear.sender)
        if not self.epochs.can_open(clear.epoch):
            raise MalformedDatagramError("epoch out of range")
        if life is not None and clear.boot < life.boot:
            raise MalformedDatagramError("old boot")
        if life is not None and clear.boot == life.boot and not life.window.is_fresh(clear.sequence):
            raise MalformedDatagramError("replayed")
        body = self._authentic(datagram, clear)
        if life is None or clear.boot != life.boot:
            life = self._lives[clear.sender] = _Life(clear.boot)
        life.window.accept(clear.sequence)
        if clear.epoch > self.epochs.current:
            self.epochs.follow(clear.epoch)
        if clear.type in REQUESTS:
            life.requests[clear.type] = max(clear.sequence, life.requests.get(clear.type, 0))
        return self.arithmetic.understood(clear, body)

    def _authentic(self, datagram: bytes, clear: Clear) -> bytes:
        """The body, if the group's secret and the sender's signature vouch for it."""
        keys = self.epochs.keys_of(clear.epoch, clear.sender, clear.boot)
        body, claim = self.arithmetic.decrypted(keys, datagram, clear, self._domain, self.public_keys[clear.sender])
        if not self.arithmetic.verified(claim):
            raise MalformedDatagramError("not signed by its sender")
        self.epochs.remember(clear.epoch, clear.sender, clear.boot, keys)
        return body

    def is_asked(self, request: Request, code: int) -> bool:
        """Whether a response of type `code` counts: no newer request of that kind by that sender is known.

        Of others a request need not have been heard; its own it knows.
        """
        asking = REQUEST_OF[code]
        if request.sender == self.agent_id:
            return request.boot == self.boot and request.sequence == self._asked.get(asking)
        if request.sender not in self.public_keys:
            return False
        life = self._lives.get(request.sender)
        if life is None or request.boot > life.boot:
            return True
        return request.boot == life.boot and request.sequence >= life.requests.get(asking, 0)
