"""Missions with keys: who is answered, what is dropped, and what a revocation makes of it."""

import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from harness.conformance._reference_model import AGENT, PEERS, ROSTER
from harness.conformance.cases._bench import CALM_S, INCEPTION, PATIENCE_S, Alone, Bench, CannotTellError, case, must
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
ASKS, LOST = PEERS[:2]
SECTION = "contract, Secured missions"


class Air:
    """What the peers of a secured agent say and hear, who have keys."""

    def __init__(self, agent: Alone, keys: "KeySet") -> None:
        from ucp.secure.opening import Opener
        from ucp.secure.secured_agent import make_boot
        from ucp.secure.session import Session

        boot = make_boot(round(time.time() * MICROSECONDS), os.urandom(8))
        self.sessions = {peer: Session(keys.bundle(peer), boot) for peer in (ASKS, LOST)}
        self.agent = agent
        self._opener = Opener(keys.bundle(ASKS))
        self._sequence = 0

    def sealed(self, sender: int, message: Message) -> bytes:
        """Its next datagram."""
        self._sequence += 1
        return self.sessions[sender].seal(self._sequence, message, None, None, 0)

    async def hear(self, count: int, what: str) -> "list[OpenedDatagram]":
        """The next datagrams, which anybody with keys can open."""
        ear, until = self.agent.ear, time.time() + PATIENCE_S
        while len(ear.heard) < count and time.time() < until:
            ear.drain()
            await ear.arrival(min(until, time.time() + CALM_S))
        datagrams = [data for _, data in ear.heard[:count]]
        del ear.heard[:count]
        must(len(datagrams) == count, what, f"{len(datagrams)} datagrams")
        try:
            return [self._opener.open(data) for data in datagrams]
        except MalformedDatagramError as error:
            must(False, f"{what}, authentic and sealed", f"one that is not: {error.reason}")
            raise

    async def answers_only(self, after: str) -> bytes:
        """It answers a new question, naming that, and has said nothing else; the question as it was sent."""
        asked = self.sealed(ASKS, ChainContainQuery(INCEPTION))
        self.agent.ear.say(asked)
        (heard,) = await self.hear(1, f"an answer after {after}")
        must(
            heard.datagram.message == ChainContainResponse(INCEPTION, True),
            f"that answer after {after}",
            heard.datagram,
        )
        request = heard.request
        named = None if request is None else (request.sender, request.boot, request.sequence)
        right = ASKS, self.sessions[ASKS].boot, self._sequence
        must(named == right, "an answer that names the request", named)
        return asked


@asynccontextmanager
async def _secured(bench: Bench) -> AsyncIterator[tuple[Air, "KeySet"]]:
    try:
        from ucp.secure.bundle import KeySet, write_bundle
    except ModuleNotFoundError as error:
        raise CannotTellError(f"{error.name} is not installed here: pip install ucp-harness[secure]") from None
    keys = KeySet.derived(os.urandom(32), ROSTER)

    def prepare(directory: Path) -> None:
        write_bundle(directory / BUNDLE, keys.bundle(AGENT))

    asked = {"features": ["secured"], "security": {"bundle": BUNDLE}}
    async with bench.agent(asked, prepare=prepare) as agent:
        yield Air(agent, keys), keys


@case("with keys, only authentic and new datagrams have an effect", SECTION)
async def _authentic(bench: Bench) -> None:
    from ucp.secure.bundle import KeySet
    from ucp.secure.envelope import CLEAR
    from ucp.secure.session import Session

    async with _secured(bench) as (air, keys):
        before = await air.answers_only("its start")
        query = ChainContainQuery(INCEPTION)
        strangers = Session(KeySet.derived(os.urandom(32), ROSTER).bundle(ASKS), air.sessions[ASKS].boot)
        elder = Session(keys.bundle(ASKS), bytes(16))
        fresh = air.sealed(ASKS, query)
        parts = {"header": 9, "ciphertext": CLEAR.size, "tag": len(fresh) - 80, "signature": len(fresh) - 1}
        hostile = {
            "that is a replay": before,
            "in plain": encode(ASKS, 1, query),
            "of another mission": strangers.seal(500, query, None, None, 0),
            "of an earlier life": elder.seal(501, query, None, None, 0),
            "that is cut off": fresh[:-1],
            "that answers no request": air.sealed(ASKS, ChainContainResponse(INCEPTION, True)),
            **{
                f"with a bit flipped in its {name}": fresh[:at] + bytes([fresh[at] ^ 1]) + fresh[at + 1 :]
                for name, at in parts.items()
            },
        }
        for what, datagram in hostile.items():
            air.agent.ear.say(datagram)
            await air.answers_only(f"a datagram {what}")


@case("with keys, blocks are signed in messages and in the export", SECTION, 1)
async def _signed(bench: Bench) -> None:
    from ucp.secure.block_signature import block_claim
    from ucp.secure.crypto_suite import verify

    async with _secured(bench) as (air, keys):
        while (await air.agent.status())["completed"] == 0:
            await air.agent.log(bytes(200))
        proposed, committed = await air.hear(2, "a Block Add Request and a Commit Block")
        must(isinstance(proposed.datagram.message, BlockAddRequest), "a Block Add Request", proposed.datagram)
        message = committed.datagram.message
        assert isinstance(message, CommitBlock), "it follows the other"
        public = keys.public.vehicles[AGENT], keys.public.mission, message.block.block_data()
        must(
            verify(block_claim(*public, committed.block_signature)),
            "a Commit Block with its maker's signature",
            "another",
        )


@case("with keys, a revocation is passed on, and revoked senders are dropped", SECTION)
async def _revoked(bench: Bench) -> None:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from ucp.secure.revocation import Revocation

    async with _secured(bench) as (air, keys):
        authority = Ed25519PrivateKey.from_private_bytes(keys.authority)
        forged = Revocation.signed(Ed25519PrivateKey.generate(), keys.public.mission, 2, [ASKS]).encode()
        air.agent.ear.say(air.sessions[LOST].revocation_datagram(2, forged))
        await air.answers_only("a revocation that the authority did not sign")
        body = Revocation.signed(authority, keys.public.mission, 1, [LOST]).encode()
        air.agent.ear.say(air.sessions[ASKS].revocation_datagram(1, body))
        await asyncio.sleep(CALM_S)
        told = [data for _, data in air.agent.ear.take()]
        must(any(data.endswith(body) for data in told), "the revocation, passed on", f"{len(told)} other datagrams")
        air.agent.ear.say(air.sealed(LOST, ChainContainQuery(INCEPTION)))
        await asyncio.sleep(CALM_S)
        heard = air.agent.ear.take()
        must(not heard, "nothing after a question of a revoked vehicle", f"{len(heard)} datagrams")
