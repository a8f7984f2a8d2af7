"""Test cases about secured missions: valid and forged datagrams, signed blocks, and the exclusion of vehicles."""

import asyncio
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from harness.conformance._reference_model import AGENT, PEERS, ROSTER
from harness.conformance.cases._bench import (
    INCEPTION,
    PATIENCE_S,
    SILENCE_S,
    BenchAgent,
    CannotJudgeError,
    CaseBench,
    case,
    require,
)
from ucp.clock import MICROSECONDS
from ucp.messages import (
    BlockAddRequest,
    ChainContainQuery,
    ChainContainResponse,
    CommitBlock,
    MalformedDatagramError,
    Message,
    encode,
)

if TYPE_CHECKING:
    from ucp.secure.bundle import KeySet
    from ucp.secure.sealed_datagrams import OpenedDatagram

BUNDLE = "keys.json"
ASKING_PEER, LOST_PEER = PEERS[:2]
SECTION = "contract, Secured missions"
CRYPTOGRAPHY = "cryptography"


def secured_case(name: str, algorithm: int = 0) -> Callable[[Callable[[CaseBench], Awaitable[None]]], None]:
    """Return a decorator that adds a test case with keys. Without the extra `secure`, the case is not applicable."""

    def declare(play: Callable[[CaseBench], Awaitable[None]]) -> None:
        async def play_with_keys(bench: CaseBench) -> None:
            if find_spec(CRYPTOGRAPHY) is None:
                raise CannotJudgeError(f"{CRYPTOGRAPHY} is not installed here: run `pip install 'ucp-harness[secure]'`")
            await play(bench)

        case(name, SECTION, algorithm)(play_with_keys)

    return declare


class SecuredPeers:
    """The simulated peers of the tested agent in a secured mission, with their keys."""

    def __init__(self, agent: BenchAgent, keys: "KeySet") -> None:
        from ucp.secure.opening import DatagramOpener
        from ucp.secure.secured_agent import make_boot
        from ucp.secure.session import Session

        boot = make_boot(round(time.time() * MICROSECONDS), os.urandom(8))
        self.sessions = {peer: Session(keys.bundle(peer), boot, has_budgets=False) for peer in (ASKING_PEER, LOST_PEER)}
        self.agent = agent
        self._opener = DatagramOpener(keys.bundle(ASKING_PEER))
        self._sequence = 0

    def sealed(self, sender: int, message: Message) -> bytes:
        """Return the next datagram of a simulated agent. It is encrypted and signed with this agent's keys."""
        self._sequence += 1
        return self.sessions[sender].seal(self._sequence, message, None, None, 0)

    def revocation_in(self, datagram: bytes) -> bytes | None:
        """Return the body of a revocation, the message that excludes vehicles. Return None for any other datagram."""
        from ucp.secure.envelope import REVOCATION, read_clear_header

        try:
            clear = read_clear_header(datagram)
            if clear.type != REVOCATION:
                return None
            return self.sessions[ASKING_PEER].open_revocation(datagram, clear, 0.0)
        except MalformedDatagramError:
            return None

    async def receive(self, count: int, what: str) -> "list[OpenedDatagram]":
        """Return the next datagrams of the tested agent. A simulated agent decrypts them with its keys.

        Raises WrongBehaviourError if fewer arrive, or if one is not authentic.
        """
        peer_socket, until = self.agent.peer_socket, time.time() + PATIENCE_S
        while self._drop_challenges() < count and time.time() < until:
            peer_socket.drain()
            await peer_socket.arrival(min(until, time.time() + SILENCE_S))
        datagrams = [data for _, data in peer_socket.received[:count]]
        del peer_socket.received[:count]
        require(len(datagrams) == count, what, f"{len(datagrams)} datagrams")
        try:
            return [self._opener.open(data) for data in datagrams]
        except MalformedDatagramError as error:
            require(False, f"{what}, authentic and sealed", f"one that is not: {error.reason}")
            raise

    def _drop_challenges(self) -> int:
        """Remove challenges and echoes from the received datagrams. Return the number of the remaining datagrams."""
        from ucp.secure.envelope import CHALLENGE, ECHO

        received = self.agent.peer_socket.received
        received[:] = [(at_s, data) for at_s, data in received if data[3:4] not in (bytes([CHALLENGE]), bytes([ECHO]))]
        return len(received)

    async def require_single_answer(self, after: str) -> bytes:
        """Ask the agent whether its chain contains the inception block. Raise WrongBehaviourError if its next datagram
        is not the answer to this query.

        Return the datagram of the request.
        """
        asked = self.sealed(ASKING_PEER, ChainContainQuery(INCEPTION))
        self.agent.peer_socket.send(asked)
        (received,) = await self.receive(1, f"an answer after {after}")
        require(
            received.datagram.message == ChainContainResponse(INCEPTION, True),
            f"that answer after {after}",
            received.datagram,
        )
        request = received.request
        named = None if request is None else (request.sender, request.boot, request.sequence)
        right = ASKING_PEER, self.sessions[ASKING_PEER].boot, self._sequence
        require(named == right, "an answer that names the request", named)
        return asked


@asynccontextmanager
async def _secured(bench: CaseBench) -> AsyncIterator[tuple[SecuredPeers, "KeySet"]]:
    from ucp.secure.bundle import KeySet, write_bundle

    if bench.lab.remote is not None and not bench.lab.remote.is_encrypted:
        raise CannotJudgeError(
            "the connection to the agent is not encrypted: run `pip install 'ucp-harness[secure]'` on its computer"
        )
    keys = KeySet.derived(os.urandom(32), ROSTER)

    def prepare(directory: Path) -> None:
        write_bundle(directory / BUNDLE, keys.bundle(AGENT))

    asked = {"features": ["secured"], "security": {"bundle": BUNDLE}}
    async with bench.agent(asked, prepare=prepare) as agent:
        yield SecuredPeers(agent, keys), keys


@secured_case("with keys, only authentic and new datagrams have an effect")
async def _authentic(bench: CaseBench) -> None:
    from ucp.secure.bundle import KeySet
    from ucp.secure.envelope import CLEAR
    from ucp.secure.session import Session

    async with _secured(bench) as (peers, keys):
        before = await peers.require_single_answer("its start")
        query = ChainContainQuery(INCEPTION)
        foreign_session = Session(
            KeySet.derived(os.urandom(32), ROSTER).bundle(ASKING_PEER), peers.sessions[ASKING_PEER].boot
        )
        earlier_session = Session(keys.bundle(ASKING_PEER), bytes(16))
        fresh = peers.sealed(ASKING_PEER, query)
        parts = {"header": 9, "ciphertext": CLEAR.size, "signature": len(fresh) - 80, "tag": len(fresh) - 1}
        hostile = {
            "that is a replay": before,
            "in plain": encode(ASKING_PEER, 1, query),
            "of another mission": foreign_session.seal(500, query, None, None, 0),
            "of an earlier life": earlier_session.seal(501, query, None, None, 0),
            "that is cut off": fresh[:-1],
            "that answers no request": peers.sealed(ASKING_PEER, ChainContainResponse(INCEPTION, True)),
            **{
                f"with a bit flipped in its {name}": fresh[:at] + bytes([fresh[at] ^ 1]) + fresh[at + 1 :]
                for name, at in parts.items()
            },
        }
        for what, datagram in hostile.items():
            peers.agent.peer_socket.send(datagram)
            await peers.require_single_answer(f"a datagram {what}")


@secured_case("with keys, a recorded echo does not restore an earlier boot")
async def _recorded_echo(bench: CaseBench) -> None:
    from ucp.secure.envelope import CHALLENGE, read_clear_header
    from ucp.secure.secured_agent import make_boot
    from ucp.secure.session import Session

    async with _secured(bench) as (peers, keys):
        await peers.require_single_answer("its start")
        bundle, socket = keys.bundle(ASKING_PEER), peers.agent.peer_socket
        earlier = Session(bundle, bytes(16))
        earlier.set_clock(0.0)
        socket.send(earlier.seal(0, ChainContainQuery(INCEPTION), None, None, 0))
        await asyncio.sleep(SILENCE_S)
        challenges = [data for _, data in socket.take() if data[3] == CHALLENGE]
        require(len(challenges) == 1, "a challenge to a sender with an earlier boot", f"{len(challenges)} challenges")
        earlier.receive_challenge(challenges[0], read_clear_header(challenges[0]), 0.0)
        (echo,) = earlier.control_datagrams(0, 0.0)
        socket.send(echo)
        peers.sessions[ASKING_PEER] = earlier
        await peers.require_single_answer("an echo of the earlier boot")
        peers.sessions[ASKING_PEER] = Session(bundle, make_boot(round(time.time() * MICROSECONDS), os.urandom(8)))
        await peers.require_single_answer("a later boot")
        socket.send(echo)
        await peers.require_single_answer("the same echo again")


@secured_case("with keys, blocks are signed in messages and in the export", 1)
async def _signed(bench: CaseBench) -> None:
    from ucp.secure.block_signature import block_claim
    from ucp.secure.crypto_suite import verify

    async with _secured(bench) as (peers, keys):
        while (await peers.agent.status())["completed"] == 0:
            await peers.agent.log(bytes(200))
        proposed, committed = await peers.receive(2, "a Block Add Request and a Commit Block")
        require(isinstance(proposed.datagram.message, BlockAddRequest), "a Block Add Request", proposed.datagram)
        message = committed.datagram.message
        assert isinstance(message, CommitBlock), "no Commit Block after the Block Add Request"
        public = keys.public.vehicles[AGENT], keys.public.mission, message.block.block_data()
        require(
            verify(block_claim(*public, committed.block_signature)),
            "a Commit Block with its maker's signature",
            "another",
        )


@secured_case("with keys, a revocation is passed on, and revoked senders are dropped")
async def _revoked(bench: CaseBench) -> None:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from ucp.secure.revocation import Revocation

    async with _secured(bench) as (peers, keys):
        authority = Ed25519PrivateKey.from_private_bytes(keys.authority)
        forged = Revocation.signed(Ed25519PrivateKey.generate(), keys.public.mission, 2, [ASKING_PEER]).encode()
        peers.agent.peer_socket.send(peers.sessions[LOST_PEER].seal_revocation(forged, 2))
        await peers.require_single_answer("a revocation that the authority did not sign")
        body = Revocation.signed(authority, keys.public.mission, 1, [LOST_PEER]).encode()
        peers.agent.peer_socket.send(peers.sessions[ASKING_PEER].seal_revocation(body, 1))
        await asyncio.sleep(SILENCE_S)
        passed_on = [peers.revocation_in(data) for _, data in peers.agent.peer_socket.take()]
        require(body in passed_on, "the revocation, passed on", f"{len(passed_on)} other datagrams")
        peers.agent.peer_socket.send(peers.sealed(LOST_PEER, ChainContainQuery(INCEPTION)))
        await asyncio.sleep(SILENCE_S)
        received = peers.agent.peer_socket.take()
        require(not received, "nothing after a question of a revoked vehicle", f"{len(received)} datagrams")
