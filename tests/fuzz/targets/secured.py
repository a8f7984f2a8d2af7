"""Fuzz target: an agent with keys.

The input is a sequence of operations. Each operation is a byte that is followed by its arguments. Other agents send any
messages, of any epoch and any incarnation. The messages may be correct, damaged, repeated, or signed with the keys of
another agent. The authority may exclude any agent.

These conditions hold for any input. The agent raises no exception. Its memory is limited by the numbers of vehicles and
blocks. A datagram that is dropped before its signature is verified changes nothing. The agent behaves like one that
shares cached cryptography with other agents in virtual time.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from harness.play.simulation._crypto_cache import cached_crypto
from tests.fuzz.finding import require
from ucp.block import Block
from ucp.events import LoggableEvent
from ucp.messages import (
    MAX_DATAGRAM_BYTES,
    BlockAddRequest,
    BlockResponse,
    ChainContainResponse,
    CommitBlock,
    MalformedDatagramError,
    Message,
    NextInSequenceResponse,
)
from ucp.secure._epochs import MAX_CACHED_KEYS, MAX_EPOCHS_FOLLOWED
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import KeySet
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret
from ucp.secure.envelope import CLEAR, MAGIC, SEAL_BYTES, TAG_BYTES, VERSION, ClearHeader, read_clear_header
from ucp.secure.opening import DatagramOpener
from ucp.secure.revocation import Revocation
from ucp.secure.sealed_datagrams import CRYPTO_FUNCTIONS, NO_REQUEST, AnsweredRequest, CryptoFunctions, signing_domain
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session
from ucp.settings import Settings
from ucp.store import StoredState

ROSTER = (1, 2, 3, 4)
KEYS = KeySet.derived(b"fuzz".ljust(32, b"\0"), ROSTER, epoch_s=60.0)
SETTINGS = Settings(max_block_bytes=64, max_event_bytes=64)
MOST_OPERATIONS = 120
KEPT = 32
"""Maximum number of sent datagrams that are kept, so that operations can repeat them."""
BLOCKS = [Block(2, 1_000_000, b"of two"), Block(3, 1_000_000, b"of three"), Block(9, 7, b"of nobody")]
BEFORE_ITS_SIGNATURE = {
    *("truncated", "oversized", "wrong magic", "not secured", "wrong version", "impossible sender", "unknown type"),
    *("own sender", "sender not on the roster", "revoked sender", "not signed by the authority", "known already"),
    *("not confirmed", "too many wrong signatures", "too many unknown boots"),
    *("epoch out of range", "old boot", "replayed", "not authentic", "not signed by its sender"),
}


class _InputBytes:
    """The bytes of an input, which are read one after another. After the end, `byte` returns 0 and `take` returns no
    bytes.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._position = data, 0

    @property
    def over(self) -> bool:
        return self._position >= len(self._data)

    def byte(self) -> int:
        return int.from_bytes(self.take(1), "big")

    def take(self, count: int) -> bytes:
        self._position += count
        return self._data[self._position - count : self._position]


class _DrivenAgent:
    """The agent under test, and the last datagrams that other agents have sent to it."""

    def __init__(self, crypto: CryptoFunctions) -> None:
        self.now = 0.0
        self._crypto = crypto
        self._life = 0
        self.agent = self._born()
        self._said: list[bytes] = [b""]
        self._sequence = 0
        self._number = 0
        self._secrets = [KEYS.group_secret]
        for _ in range(64):
            self._secrets.append(next_epoch_secret(self._secrets[-1], KEYS.public.mission))

    def _born(self) -> SecuredAgent:
        self._life += 1
        session = Session(KEYS.bundle(1), make_boot(self._life, bytes(8)), crypto=self._crypto)
        return SecuredAgent(session, 1, ROSTER, b"fuzz", SETTINGS)

    def operate(self, program: _InputBytes) -> None:
        operation = program.byte() % 16
        if operation == 0:
            self._receive(program.take(program.byte() * 6))
        elif operation < 5:
            self._receive(self._sealed(program, self._body(program)))
        elif operation < 7:
            self._receive(self._sealed(program, program.take(program.byte() * 6)))
        elif operation == 7:
            self._receive(self._said[program.byte() % len(self._said)])
        elif operation == 8:
            self._receive(self._damaged(program))
        elif operation < 11:
            self._receive(self._revocation(program))
        elif operation < 13:
            self._wait(program.byte() / (4 if operation == 11 else 0.25))
        elif operation == 13:
            event = LoggableEvent(round(self.now * 1e6), 1 + program.byte() % 254, bytes(program.byte() % 50))
            self.agent.add_event(event, self.now)
        elif operation == 14:
            self.agent.begin_reconcile(self.now)
        else:
            self._reboot()

    def _sealed(self, program: _InputBytes, said: tuple[int, bytes] | bytes) -> bytes:
        """Return an encrypted datagram of another agent, of any epoch and any incarnation. Its signature may be
        wrong.
        """
        who, lies = program.byte(), program.byte()
        sender, signer = 2 + who % 3, 2 + (who if lies % 8 else who + 1) % 3
        epoch = min(len(self._secrets) - 1, max(0, int(self.now // KEYS.public.epoch_s) + lies // 8 % 16 - 3))
        boot = make_boot(lies // 128, bytes(8))
        self._sequence += 1
        sequence = program.byte() if lies % 32 == 31 else self._sequence
        code, body = said if isinstance(said, tuple) else (who // 4 % 16, said)
        header = code, sender, sequence, len(body) + SEAL_BYTES, epoch, boot, lies % 3
        clear = CLEAR.pack(MAGIC, VERSION, *header)
        keys = SenderKeys(self._secrets[epoch], KEYS.public.mission, epoch, sender, boot)
        private_key = Ed25519PrivateKey.from_private_bytes(KEYS.vehicles[signer])
        signature = private_key.sign(signing_domain(KEYS.public.mission) + clear + body)
        datagram = clear + keys.encrypt(sequence, body + signature, clear)
        self._said = [*self._said, datagram][-KEPT:]
        return datagram

    def _body(self, program: _InputBytes) -> tuple[int, bytes]:
        """Return the type and body of a correct message. The message may answer any request."""
        code, choice = 1 + program.byte() % 9, program.byte()
        state = self.agent.state
        blocks = [*BLOCKS, *state.blocks_to_be_committed, *state.chain]
        block, chain_hash = blocks[choice % len(blocks)], state.chain.top_chain_hash
        asked = AnsweredRequest(1, self.agent.session.boot, self.agent.session._own_requests.get(code - 1, 0))
        messages: dict[int, Message] = {
            1: BlockAddRequest(block.block_hash, chain_hash),
            3: CommitBlock(block, chain_hash),
            5: ChainContainResponse(chain_hash, bool(choice & 1)),
            7: NextInSequenceResponse(chain_hash, block.block_hash if choice & 2 else None, choice),
            9: BlockResponse(block),
        }
        body = messages[code].body() if code in messages else block.block_hash
        if code == 2:
            body = bytes([choice & 1]) + block.block_hash
        if code in (2, 5, 7, 9):
            request = asked if choice & 64 else NO_REQUEST
            body = request.sender.to_bytes(4, "big") + request.boot + request.sequence.to_bytes(4, "big") + body
        if code in (3, 9):
            maker = Ed25519PrivateKey.from_private_bytes(KEYS.vehicles.get(block.agent_id, bytes(32)))
            body += sign_block(maker, KEYS.public.mission, block.block_data()) if choice & 128 else bytes(64)
        return code, body

    def _damaged(self, program: _InputBytes) -> bytes:
        datagram = bytearray(self._said[program.byte() % len(self._said)])
        if datagram:
            datagram[program.byte() * 5 % len(datagram)] ^= program.byte() or 1
        return bytes(datagram)

    def _revocation(self, program: _InputBytes) -> bytes:
        who = program.byte()
        authority = KEYS.authority if who % 8 else bytes(32)
        self._number += 1
        body = Revocation.signed(
            Ed25519PrivateKey.from_private_bytes(authority), KEYS.public.mission, self._number, {1 + who // 8 % 6}
        ).encode()
        if who % 4 == 3:
            body = program.take(program.byte())
        sender, sequence, epoch = 2 + who % 3, program.byte(), program.byte() % len(self._secrets)
        header = ClearHeader(10, sender, sequence, epoch, bytes(16), self._number % 2**16)
        clear = header.pack(len(body) + TAG_BYTES)
        keys = SenderKeys(self._secrets[epoch], KEYS.public.mission, epoch, sender, bytes(16))
        return clear + keys.encrypt(header.position, body, clear)

    def _receive(self, data: bytes) -> None:
        agent, before = self.agent, _comparable_state(self.agent)
        dropped, handled = agent.dropped.copy(), agent.received.total()
        trusted = {*agent.session._incarnations}
        epoch = agent.session.epochs.bundle.epoch
        agent.receive_datagram(data, self.now)
        reasons = agent.dropped - dropped
        has_moved_on = agent.session.epochs.bundle.epoch != epoch or {*agent.session._incarnations} != trusted
        if reasons and set(reasons) <= BEFORE_ITS_SIGNATURE and not has_moved_on:
            require(_comparable_state(agent) == before, f"dropped as {list(reasons)}, and the agent is another")
        if not reasons and agent.received.total() == handled:
            require(read_clear_header(data).type >= 10, "neither dropped nor handled")
        self.look()

    def _wait(self, seconds: float) -> None:
        until = self.now + seconds
        while (ends := self.agent.next_timer()) is not None and ends <= until:
            self.now = ends
            self.agent.handle_timer(ends)
            self.look()
        self.now = until

    def _reboot(self) -> None:
        stored = StoredState.of(self.agent.state)
        stored.secured = self.agent.secured_state()
        self.agent = self._born()
        self.agent.boot(stored, self.now)

    def look(self) -> None:
        """Check the agent: other agents can decrypt the sent messages, memory is limited, and the trace can be
        written.
        """
        agent, session = self.agent, self.agent.session
        for datagram in agent.datagrams_to_send():
            require(len(datagram) <= MAX_DATAGRAM_BYTES, "it sends what no datagram holds")
            if read_clear_header(datagram).type < 10:
                DatagramOpener(KEYS.bundle(2)).open(datagram)
        for entry in agent.trace():
            entry.to_line()
        state = agent.state
        held = len(state.chain) + len(state.blocks_to_be_committed) + len(state.reconcile_stack)
        require(len(session._incarnations) < len(ROSTER), "it remembers senders that there are not")
        require(all(len(each.requests) <= 4 for each in session._incarnations.values()), "it keeps too many requests")
        require(len(session.epochs._sender_keys) <= MAX_CACHED_KEYS, "it keeps too many keys")
        require(len(agent._answered_requests) == 0, "it keeps what its answers answered")
        require(len(agent.signatures) <= held + len(state.completed), "it keeps signatures of what it does not hold")
        ahead = session.epochs.current - session.epochs.bundle.epoch
        require(ahead <= MAX_EPOCHS_FOLLOWED, "others have driven it too far")


def _is_accepted(session: Session, sealed_by: tuple[int, int, bytes]) -> bool:
    """Return whether the session already accepts datagrams from this start of the sender. In this case, the session
    keeps the keys of this start.
    """
    _, sender, boot = sealed_by
    incarnation = session._incarnations.get(sender)
    return incarnation is not None and incarnation.boot == boot


def _comparable_state(agent: SecuredAgent) -> dict[str, Any]:
    """Return all data of the agent that a datagram might change, for comparison."""
    state, session = agent.state, agent.session
    return {
        "received": agent.received.copy(),
        "chain": (len(state.chain), state.chain.top_chain_hash, len(state.blocks_to_be_committed)),
        "reconcile": (state.reconcile_in_progress, len(state.reconcile_stack), state.vote_count.copy()),
        "timers": [timer.deadline for timer in state.timers],
        "keys": {known for known in session.epochs._sender_keys if not _is_accepted(session, known)},
        "signatures": dict(agent.signatures),
        "revoked": agent.revoked,
        "heard": {
            sender: (life.boot, life.window._newest, tuple(life.window._words), dict(life.requests))
            for sender, life in session._incarnations.items()
        },
    }


def _driven(data: bytes, crypto: CryptoFunctions) -> tuple[object, ...]:
    program, driven = _InputBytes(data), _DrivenAgent(crypto)
    for _ in range(MOST_OPERATIONS):
        if program.over:
            break
        driven.operate(program)
    agent = driven.agent
    return _comparable_state(agent), agent.dropped, agent.session.epochs.current


def run(data: bytes) -> None:
    require(
        _driven(data, CRYPTO_FUNCTIONS) == _driven(data, cached_crypto()), "cached cryptography gives another result"
    )
    with suppress(MalformedDatagramError):
        DatagramOpener(KEYS.bundle(1)).open(data)


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield sequences of operations: a vote, commits with and without signatures, a reconcile, epochs, restarts,
    exclusions, and a power loss.
    """
    block = bytes([13, 1, 40, 13, 1, 40, 13, 1, 40])
    commit, unsigned = bytes([1, 2, 128, 0, 24 + 1]), bytes([1, 2, 0, 0, 24 + 1])
    vote = bytes([1, 1, 67, 0, 24 + 1])
    yield block + vote + vote + bytes([11, 60])
    yield commit + unsigned + bytes([7, 0, 7, 1, 8, 1, 3, 9])
    yield bytes([14, 1, 4, 65, 0, 25, 11, 60, 1, 6, 67, 1, 25, 11, 60, 1, 8, 193, 2, 25, 11, 60])
    yield bytes([12, 20, 1, 0, 0, 0, 25, 1, 0, 0, 1, 25 + 8, 1, 0, 0, 1, 255, 7, 1])
    yield bytes([9, 9, 0, 0, 9, 17, 0, 0, 1, 2, 128, 0, 25, 9, 8, 0, 0, 9, 11, 5, 1, 2, 3, 4, 5, 0, 0])
    yield (
        block
        + bytes([15])
        + commit
        + bytes([5, 3, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 4, 25])
    )
