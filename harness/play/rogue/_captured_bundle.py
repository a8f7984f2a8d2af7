"""Let an attacker use the keys of a captured vehicle to decrypt datagrams and to sign new ones.

With the group secret, the attacker can decrypt the datagrams of all senders, and compute the encryption keys of any
sender. It does not have the signature keys of other vehicles. It therefore signs a block in another vehicle's name with
the key of the captured vehicle.
"""

from collections.abc import Callable
from dataclasses import replace

from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import Bundle
from ucp.secure.opening import DatagramOpener
from ucp.secure.sealed_datagrams import AnsweredRequest
from ucp.secure.secured_agent import make_boot
from ucp.secure.session import Session


class CapturedKeys:
    """The keys of a captured vehicle. `random_bytes` returns 8 random bytes for each forged restart of a vehicle.
    `now_us` is the time in microseconds UTC. Other times are mission seconds.
    """

    def __init__(self, bundle: Bundle, random_bytes: Callable[[], bytes]) -> None:
        self.agent_id = bundle.agent_id
        self._bundle = bundle
        self._random_bytes = random_bytes
        self._opener = DatagramOpener(bundle)
        self._sessions: dict[int, Session] = {}
        """Imitated sender -> the forged session. A session numbers the encrypted datagrams between two restarts of a
        sender.
        """
        self._signatures: dict[bytes, bytes] = {}
        """The genuine signatures in received datagrams, by the hash of the signed block."""

    def opened(self, datagram: bytes) -> tuple[Message, AnsweredRequest] | None:
        """Decrypt a datagram. Return its message, and the identification that an answer to it must contain.

        Return None if the keys do not decrypt the datagram.
        """
        try:
            opened = self._opener.open(datagram)
        except MalformedDatagramError:
            return None
        clear = opened.clear
        message = opened.datagram.message
        if type(message) in CARRY_A_BLOCK:
            self._signatures[message.block.block_hash] = opened.block_signature  # type: ignore[union-attr]
        return message, AnsweredRequest(clear.sender, clear.boot, clear.sequence)

    def sealed(
        self, sender: int, sequence: int, message: Message, request: AnsweredRequest | None, now: float, now_us: int
    ) -> bytes:
        """Return an encrypted datagram in the name of `sender`. The encryption is valid. If a block has no known
        genuine signature, it is signed with the key of the captured vehicle. Use each sequence number once.
        """
        session = self._sessions.get(sender)
        if session is None:
            session = self._sessions[sender] = self._session(sender, now_us)
        session.epochs.set_clock(now)
        signature = None
        if type(message) in CARRY_A_BLOCK:
            block = message.block  # type: ignore[union-attr]
            received = self._signatures.get(block.block_hash)
            signature = received or sign_block(session.private_key, session.mission, block.block_data())
        return session.seal(sequence, message, request, signature, 0)

    def _session(self, sender: int, now_us: int) -> Session:
        """Return a forged session of the sender that begins now, as after a restart. Receivers prefer this session to
        the sender's genuine session, because it is newer.
        """
        return Session(replace(self._bundle, agent_id=sender), make_boot(now_us, self._random_bytes()))
