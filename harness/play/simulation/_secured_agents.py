"""Secured agents in virtual time.

All of it comes of the run's seed. Every datagram is sealed, and opened by whom it reaches; what many receivers work out
of the same bytes is remembered (`_crypto_cache.py`).
"""

import hashlib
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

from harness.play._vehicle_keys import mission_keys
from harness.play.rogue._captured_bundle import CapturedKeys
from harness.play.simulation._crypto_cache import remembered
from harness.play.simulation._simulated_agent import OwnAgent
from harness.scenario import Scenario
from netem.medium import LATENCY
from ucp.clock import MICROSECONDS
from ucp.export import export_chain
from ucp.secure.bundle import Bundle
from ucp.secure.sealing import make_seal
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session
from ucp.store import StoredState


class SecuredOwnAgent(SecuredAgent, OwnAgent):
    """The harness's own, with keys."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return export_chain(self.state, exported_at_us, self.signatures)

    def stored(self, now: float) -> StoredState:
        stored = super().stored(now)
        stored.secured = self.secured_state()
        return stored


class Keys:
    """What the vehicles of a simulated mission have, and go on with when they come back.

    `told`: somebody may yet inject. Raises HarnessError.
    """

    def __init__(self, scenario: Scenario, seed: int, *, told: bool) -> None:
        self.nothing_is_dropped = not told and _drops_nothing(scenario)
        """Whether agents handle all that reaches them, so that what cannot matter need not be delivered."""
        self._seed = seed
        keys = mission_keys(scenario, _of_seed(seed, "keys"))
        assert keys is not None, "the scenario is secured"
        self.mission = keys
        self._bundles: dict[int, Bundle] = dict(keys.bundles)
        captured = scenario.security.captured if scenario.security else None
        chance = Random(f"{seed}/captured")
        self.captured = None if captured is None else CapturedKeys(self._bundles[captured], lambda: chance.randbytes(8))
        """What the rogue node has."""
        self.crypto = remembered()

    def agent(self, agent_id: int, life: int, now: float) -> Callable[..., SecuredOwnAgent]:
        """What makes the agent of a life that begins `now`, in mission seconds; lives are counted from 1."""

        def keep(bundle: Bundle) -> None:
            self._bundles[agent_id] = bundle

        boot = self._boot(agent_id, life, now)
        bundle = self._bundles[agent_id]
        session = Session(bundle, boot, keep, self.crypto)
        return partial(SecuredOwnAgent, session, seal=make_seal(bundle) if self.mission.seals else None)

    def handed(self, agent_id: int, life: int, now: float) -> dict[str, Any]:
        """What an agent of another make is told of its keys when a life begins."""
        return {"bundle": self.mission.bundles[agent_id].to_json(), "boot": self._boot(agent_id, life, now).hex()}

    def _boot(self, agent_id: int, life: int, now: float) -> bytes:
        return make_boot(round(now * MICROSECONDS) + life, _of_seed(self._seed, f"boot {agent_id} {life}")[:8])


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
        or any(step.network.without_partition().needs() for step in scenario.network_steps())
        or min(timers.vote_timeout_s, timers.phase1_timeout_s, timers.phase2_timeout_s, timers.phase3_timeout_s)
        <= 2 * (LATENCY.mean_s + LATENCY.jitter_s)
    )


def _of_seed(seed: int, what: str) -> bytes:
    """32 bytes that everybody who knows the seed can work out: keys of a simulated mission are no secrets."""
    return hashlib.sha256(f"{what} of seed {seed}".encode()).digest()
