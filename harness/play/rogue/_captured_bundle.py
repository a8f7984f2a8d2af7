"""What whoever captured a vehicle can do with its bundle: open what is on the air, and seal with the vehicle's keys.

The group's secret opens everybody's datagrams, and makes the keys of any sender. What it does not make is another
vehicle's signature: so what is sealed here in another's name is signed with the captured vehicle's key, as there is no
other.
"""

from collections.abc import Callable
from dataclasses import replace

from ucp.messages import CARRY_A_BLOCK, MalformedDatagramError, Message
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import read_clear
from ucp.secure.sealed_datagrams import Request
from ucp.secure.secured_agent import boot_of
from ucp.secure.session import Session


class CapturedKeys:
    """`chance` gives 8 bytes for each life that is made up. Times are mission seconds, and microseconds UTC."""

    def __init__(self, bundle: Bundle, chance: Callable[[], bytes]) -> None:
        self.agent_id = bundle.agent_id
        self._bundle = bundle
        self._chance = chance
        self._ear = self._session(bundle.agent_id, 0)
        self._mouths: dict[int, Session] = {}
        """By the sender in whose name it speaks."""
        self._signatures: dict[bytes, bytes] = {}
        """The makers', of all blocks that were on the air."""

    def opened(self, datagram: bytes, now: float) -> tuple[Message, Request] | None:
        """What a datagram says, and how an answer would name it; None if it is nothing new that can be opened."""
        self._ear.epochs.look_at(now)
        try:
            clear = read_clear(datagram)
            opened = self._ear.open(datagram, clear)
        except (MalformedDatagramError, KeyError):  # of a sender of another mission
            return None
        message = opened.said.message
        if type(message) in CARRY_A_BLOCK:
            self._signatures[message.block.block_hash] = opened.block_signature  # type: ignore[union-attr]
        return message, Request(clear.sender, clear.boot, clear.sequence)

    def sealed(
        self, sender: int, sequence: int, message: Message, request: Request | None, now: float, now_us: int
    ) -> bytes:
        """A datagram in the name of `sender`, as good as these keys can make it; each sequence is used once."""
        mouth = self._mouths.get(sender)
        if mouth is None:
            mouth = self._mouths[sender] = self._session(sender, now_us)
        mouth.epochs.look_at(now)
        signature = None
        if type(message) in CARRY_A_BLOCK:
            block = message.block  # type: ignore[union-attr]
            heard = self._signatures.get(block.block_hash)
            signature = heard or sign_block(mouth.private_key, mouth.mission, block.block_data())
        return mouth.seal(sequence, message, request, signature, 0)

    def _session(self, sender: int, now_us: int) -> Session:
        """A life of that sender, which began now: it is newer than its own."""
        return Session(replace(self._bundle, agent_id=sender), boot_of(now_us, self._chance()))
