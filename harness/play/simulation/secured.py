"""Secured agents in virtual time: the same layer of security, and real datagrams.

All of it comes of the run's seed. Many receivers check one signature, and checking is a function of three strings of
bytes: so it is worked out once and remembered, for these very bytes. A receiver that checked other bytes, or with
another key, would ask for something that nobody remembers.

In a sweep without traces even that would take many times as long as the mission. Where nothing can be dropped, one
datagram of `SEALED_EVERY` is sealed and opened there, which is enough to find an agent that seals what others cannot
open; a run with traces, as every run that has a directory, seals and opens all, and tests hold the two to each other.
"""

import hashlib
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from random import Random
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from harness.play.keys import keys_of
from harness.play.rogue.captured import CapturedKeys
from harness.play.simulation.agents import OwnAgent
from harness.scenario import Scenario
from netem.medium import LATENCY
from ucp.block import Block
from ucp.clock import MICROSECONDS
from ucp.export import export_chain
from ucp.messages import CARRY_A_BLOCK, TYPE_CODES, Message
from ucp.secure.agent import Outgoing, SecuredAgent, boot_of
from ucp.secure.block_signature import sign_block
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import REQUESTS, sealed_bytes
from ucp.secure.sealing import seal_of
from ucp.secure.session import Request, Session
from ucp.secure.suite import Signed, verify
from ucp.store import StoredState
from ucp.trace import Recorded

SIGNATURES_REMEMBERED = 4096
SEALED_EVERY = 32


class SecuredOwnAgent(SecuredAgent, OwnAgent):
    """The harness's own, with keys."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return export_chain(self.state, exported_at_us, self.signatures)

    def stored(self, now: float) -> StoredState:
        stored = super().stored(now)
        stored.secured = self.secured_state()
        return stored


class SampledAgent(SecuredOwnAgent):
    """One of a swarm in which nothing is ever dropped: of its datagrams some are sealed, and opened by whom they reach.

    The others cross the air unsealed, and as long as they would be: what opening them would give is known.
    """

    def __init__(self, keys: "Keys", *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._keys = keys

    def receive_message(
        self, sender: int, sequence: int, message: Message, now: float, datagram: Recorded | None = None
    ) -> None:
        waiting = len(self._core.outbox)
        super().receive_message(sender, sequence, message, now, datagram)
        if (outbox := self._core.outbox)[waiting:] and TYPE_CODES[type(message)] in REQUESTS:
            request = Request(sender, self._keys.boots[sender], sequence)
            self._answers.update((answer, request) for answer, _, _ in outbox[waiting:])

    def sealed_to_send(self) -> Iterator[Outgoing]:
        for sequence, message, _ in self._taken_from_outbox():
            request = self._answers.pop(sequence, None)
            if sequence % SEALED_EVERY:
                self.session.asks(sequence, message)
                yield Outgoing(None, sequence, message, None, sealed_bytes(message))
            else:
                carried = type(message) in CARRY_A_BLOCK
                signature = self._keys.signature(message.block) if carried else None  # type: ignore[union-attr]
                self.session.epochs.look_at(self.state.now)
                sealed = self.session.seal(sequence, message, request, signature, 0)
                yield Outgoing(sealed, sequence, message, None, len(sealed))


class Keys:
    """What the vehicles of a simulated mission have, and go on with when they come back.

    `sampled`: nobody looks at what is on the air. Raises HarnessError.
    """

    def __init__(self, scenario: Scenario, seed: int, *, sampled: bool) -> None:
        self.sampled = sampled and _drops_nothing(scenario)
        """Whether nothing can be dropped, so that not every datagram need be sealed and opened."""
        self.boots: dict[int, bytes] = {}
        """Which life of each vehicle goes on."""
        self._seed = seed
        keys = keys_of(scenario, _of_seed(seed, "keys"))
        assert keys is not None, "the scenario is secured"
        self.mission = keys
        self._bundles: dict[int, Bundle] = dict(keys.bundles)
        captured = scenario.security.captured if scenario.security else None
        chance = Random(f"{seed}/captured")
        self.captured = None if captured is None else CapturedKeys(self._bundles[captured], lambda: chance.randbytes(8))
        """What the rogue node has."""
        self._verified: Callable[[Signed], bool] = lru_cache(SIGNATURES_REMEMBERED)(verify)

    def agent(self, agent_id: int, life: int, now: float) -> Callable[..., SecuredOwnAgent]:
        """What makes the agent of a life that begins `now`, in mission seconds; lives are counted from 1."""

        def keep(bundle: Bundle) -> None:
            self._bundles[agent_id] = bundle

        boot = self._boot(agent_id, life, now)
        bundle = self._bundles[agent_id]
        session = Session(bundle, boot, keep, self._verified)
        make = partial(SampledAgent, self) if self.sampled else SecuredOwnAgent
        return partial(make, session, seal=seal_of(bundle) if self.mission.seals else None)

    def handed(self, agent_id: int, life: int, now: float) -> dict[str, Any]:
        """What an agent of another make is told of its keys when a life begins."""
        return {"bundle": self.mission.bundles[agent_id].to_json(), "boot": self._boot(agent_id, life, now).hex()}

    def _boot(self, agent_id: int, life: int, now: float) -> bytes:
        boot = boot_of(round(now * MICROSECONDS) + life, _of_seed(self._seed, f"boot {agent_id} {life}")[:8])
        self.boots[agent_id] = boot
        return boot

    def signature(self, block: Block) -> bytes:
        """Its maker's."""
        bundle = self._bundles[block.agent_id]
        maker = Ed25519PrivateKey.from_private_bytes(bundle.private_key)
        return sign_block(maker, bundle.public.mission, block.block_data())


def _drops_nothing(scenario: Scenario) -> bool:
    """Whether secured agents handle all that reaches them, whatever the seed.

    So they do while nothing comes twice, or from anybody else, or of a former life, or so late that there is a newer
    question: where the network does no more than lose and part, and agents no more than they should.
    """
    timers = scenario.settings
    return not (
        scenario.foreign
        or scenario.fates
        or scenario.datagrams
        or scenario.clocks
        or scenario.lateness
        or scenario.has_wrong_agents
        or scenario.network.radio
        or scenario.settings.asks_after_commit
        or any(entry.fault or entry.injection for entry in scenario.timeline)
        or any(step.network.uncut().needs() for step in scenario.network_steps())
        or min(timers.vote_timeout_s, timers.phase1_timeout_s, timers.phase2_timeout_s, timers.phase3_timeout_s)
        <= 2 * (LATENCY.mean_s + LATENCY.jitter_s)
    )


def _of_seed(seed: int, what: str) -> bytes:
    """32 bytes that everybody who knows the seed can work out: keys of a simulated mission are no secrets."""
    return hashlib.sha256(f"{what} of seed {seed}".encode()).digest()
