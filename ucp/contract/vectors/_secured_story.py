"""Record an example of a secured mission, in which the other agents encrypt and sign their messages."""

import base64

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ucp.block import Block, InceptionBlock
from ucp.chain import Chain
from ucp.contract.vectors._mission_story import AGENT_ID, INITIAL_DATA, ROSTER, RecordedMission
from ucp.messages import CARRY_A_BLOCK, TYPE_CODES, Message
from ucp.sealed import seal_to
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import KeySet, bundle_name
from ucp.secure.envelope import CHALLENGE, CONTROL_NAMES, REQUEST_OF, read_clear_header
from ucp.secure.opening import DatagramOpener
from ucp.secure.revocation import Revocation
from ucp.secure.sealed_datagrams import AnsweredRequest
from ucp.secure.secured_agent import make_boot
from ucp.secure.session import Session
from ucp.trace import in_base64

KEYS = KeySet.derived(bytes(range(32, 64)), ROSTER, seals=True)
MAX_BLOCK_BYTES = 976


class SecuredStory(RecordedMission):
    """A recorded secured mission with encrypted event data."""

    def __init__(self) -> None:
        assert KEYS.public.depot is not None, "the mission seals event data"
        self.initial_data = seal_to(INITIAL_DATA, KEYS.public.depot)
        self._incarnations = 0
        self._opener = DatagramOpener(KEYS.bundle(AGENT_ID))
        self._peers = {peer: Session(KEYS.bundle(peer), make_boot(peer, b"a chance")) for peer in ROSTER}
        for session in self._peers.values():
            session.set_clock(0.0)
        self._requests: dict[int, AnsweredRequest] = {}
        """Type of a request -> the agent's last request of this type."""
        super().__init__(max_block_bytes=MAX_BLOCK_BYTES)

    def chain(self, *blocks: Block) -> Chain:
        """Return a chain with these blocks in this mission."""
        chain = Chain(InceptionBlock(self.initial_data))
        for block in blocks:
            chain.append(block)
        return chain

    def revoke(self, *agents: int) -> None:
        """Give the agent the first signed list of excluded vehicles, as a command of the control socket."""
        authority = Ed25519PrivateKey.from_private_bytes(KEYS.authority)
        revocation = Revocation.signed(authority, KEYS.public.mission, 1, agents)
        self.command("revoke", revocation=in_base64(revocation.encode()))
        del self.output["answer"]["revoked"]  # an agent may leave out this key

    def hear_again(self) -> None:
        """Give the agent the previous datagram a second time."""
        inputs = (exchange["input"] for exchange in reversed(self.exchanges))
        self.now += 0.125
        self._exchange({"datagram": next(given["datagram"] for given in inputs if "datagram" in given)})

    def echo(self, *peers: int) -> None:
        """Let these agents answer the challenge message that the agent has just sent."""
        (challenge,) = (sent for sent in self._sent() if sent[3] == CHALLENGE)
        for peer in peers:
            session = self._peers[peer]
            session.set_clock(self.now)
            session.receive_challenge(challenge, read_clear_header(challenge), self.now)
            (echo,) = session.control_datagrams(0, self.now)
            self.hear_datagram(echo)

    def _sent(self) -> list[bytes]:
        return [base64.b64decode(sent) for sent in self.output["sent"]]

    def _signature(self, block: Block) -> bytes:
        return sign_block(self._peers[block.agent_id].private_key, KEYS.public.mission, block.block_data())

    def _of_mission(self) -> dict[str, object]:
        return {"security": {"bundle": bundle_name(AGENT_ID)}}

    def _of_life(self) -> dict[str, object]:
        self._incarnations += 1
        boot = make_boot(1_795_258_278_064_591 + self._incarnations, b"a chance")
        bundle = KEYS.bundle(AGENT_ID)
        return {"bundle": (bundle if self._incarnations == 1 else bundle.used()).to_json(), "boot": boot.hex()}

    def _encoded(self, sender: int, sequence: int, message: Message) -> bytes:
        code = TYPE_CODES[type(message)]
        request = self._requests.get(REQUEST_OF[code]) if code in REQUEST_OF else None
        signature = self._signature(message.block) if type(message) in CARRY_A_BLOCK else None  # type: ignore[union-attr]
        return self._peers[sender].seal(sequence, message, request, signature, 0)

    def _message(self, datagram: bytes) -> Message | None:
        """Return the message in a datagram of the agent. Store the identification of the datagram, which answers of
        other agents must contain. Return None for a control datagram, which contains no message.
        """
        if datagram[3] in CONTROL_NAMES:
            return None
        opened = self._opener.open(datagram)
        self._requests[opened.clear.type] = AnsweredRequest(AGENT_ID, opened.clear.boot, opened.clear.sequence)
        return opened.datagram.message
