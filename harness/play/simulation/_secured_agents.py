"""Create agents with keys, which sign and verify messages in virtual time.

All keys are derived from the seed of the run, unless the scenario names a directory of keys. Agents seal and open every
datagram as in a real mission. Results that several receivers need are cached (`_crypto_cache.py`).
"""

import hashlib
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

from harness.play._vehicle_keys import mission_keys
from harness.play.rogue._captured_bundle import CapturedKeys
from harness.play.simulation._crypto_cache import cached_crypto
from harness.play.simulation._simulated_agent import OwnAgent
from harness.scenario import Scenario
from netem.medium import LATENCY
from ucp.clock import MICROSECONDS
from ucp.secure.bundle import Bundle
from ucp.secure.sealing import make_seal
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session
from ucp.store import StoredState


class SecuredOwnAgent(SecuredAgent, OwnAgent):
    """An agent of the harness that signs and encrypts its messages."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return self.signed_export(exported_at_us)

    def stored(self, now: float) -> StoredState:
        stored = super().stored(now)
        stored.secured = self.secured_state()
        return stored


class SimulatedKeys:
    """The keys of the vehicles of a simulated mission. A vehicle keeps its keys after a restart.

    `interactive` is true if a user may request injections during the run. Raises HarnessError.
    """

    def __init__(self, scenario: Scenario, seed: int, *, interactive: bool) -> None:
        self.nothing_is_dropped = not interactive and _drops_nothing(scenario)
        """True if agents drop no datagram. The simulation then need not deliver messages without effect."""
        self._seed = seed
        keys = mission_keys(scenario, _derived_bytes(seed, "keys"))
        assert keys is not None, "the scenario is secured"
        self.mission = keys
        self._bundles: dict[int, Bundle] = dict(keys.bundles)
        captured = scenario.security.captured if scenario.security else None
        chance = Random(f"{seed}/captured")
        self.captured = None if captured is None else CapturedKeys(self._bundles[captured], lambda: chance.randbytes(8))
        """The keys that the rogue node has captured."""
        self.crypto = cached_crypto()

    def agent(self, agent_id: int, incarnation: int, now: float) -> Callable[..., SecuredOwnAgent]:
        """Return a function that creates this incarnation of the agent, with its keys. The incarnation starts at
        mission second `now`.

        Incarnations are numbered from 1.
        """

        def keep(bundle: Bundle) -> None:
            self._bundles[agent_id] = bundle

        boot = self._boot(agent_id, incarnation, now)
        bundle = self._bundles[agent_id]
        session = Session(bundle, boot, keep, self.crypto)
        return partial(SecuredOwnAgent, session, seal=make_seal(bundle) if self.mission.seals else None)

    def key_fields(self, agent_id: int, incarnation: int, now: float) -> dict[str, Any]:
        """Return the keys of an agent that is a separate program, as fields of its first input line."""
        bundle = self.mission.bundles[agent_id]
        return {
            "bundle": (bundle if incarnation == 1 else bundle.used()).to_json(),
            "boot": self._boot(agent_id, incarnation, now).hex(),
        }

    def _boot(self, agent_id: int, incarnation: int, now: float) -> bytes:
        return make_boot(
            round(now * MICROSECONDS) + incarnation, _derived_bytes(self._seed, f"boot {agent_id} {incarnation}")[:8]
        )


def _drops_nothing(scenario: Scenario) -> bool:
    """Return true if agents with keys drop no datagram in this scenario, with any seed.

    Agents with keys drop copies, datagrams from other senders or earlier incarnations, and answers that arrive after
    a newer query. None of these occurs if all agents are correct, and the network has only loss and partitions.
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


def _derived_bytes(seed: int, what: str) -> bytes:
    """Return 32 bytes that depend only on the seed. The keys of a simulated mission need not be secret."""
    return hashlib.sha256(f"{what} of seed {seed}".encode()).digest()
