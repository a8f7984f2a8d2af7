"""Secured agents in virtual time: the same layer of security, and real datagrams.

All of it comes of the run's seed. Many receivers check one signature, and checking is a function of three strings of
bytes: so it is worked out once and remembered, for these very bytes. A receiver that checked other bytes, or with
another key, would ask for something that nobody remembers.
"""

import hashlib
from collections.abc import Callable
from functools import lru_cache, partial
from random import Random
from typing import Any

from harness.play.keys import bundles_of
from harness.play.rogue.captured import CapturedKeys
from harness.play.simulation.agents import OwnAgent
from harness.scenario import Scenario
from ucp.clock import MICROSECONDS
from ucp.export import export_chain
from ucp.sealed import seal_to
from ucp.secure.agent import SecuredAgent, boot_of
from ucp.secure.bundle import Bundle, PublicKeys
from ucp.secure.sealing import seal_of
from ucp.secure.session import Session
from ucp.secure.suite import Signed, verify
from ucp.store import StoredState

SIGNATURES_REMEMBERED = 4096


class SecuredOwnAgent(SecuredAgent, OwnAgent):
    """The harness's own, with keys."""

    def export(self, now: float, exported_at_us: int) -> dict[str, Any]:
        return export_chain(self.state, exported_at_us, self.signatures)

    def stored(self, now: float) -> StoredState:
        stored = super().stored(now)
        stored.secured = self.secured_state()
        return stored


class Keys:
    """What the vehicles of a simulated mission have, and go on with when they come back."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Raises HarnessError."""
        self._seed = seed
        self._seals = scenario.security is not None and scenario.security.seal
        self._bundles: dict[int, Bundle] = dict(bundles_of(scenario, _of_seed(seed, "keys")))
        captured = scenario.security.captured if scenario.security else None
        chance = Random(f"{seed}/captured")
        self.captured = None if captured is None else CapturedKeys(self._bundles[captured], lambda: chance.randbytes(8))
        """What the rogue node has."""
        self._verified: Callable[[Signed], bool] = lru_cache(SIGNATURES_REMEMBERED)(verify)

    @property
    def public(self) -> PublicKeys:
        """What everybody may know of them."""
        return next(iter(self._bundles.values())).public

    def sealed_to_depot(self, initial_data: bytes) -> bytes:
        """The inception block's data, which says to whom event data is sealed, if it is."""
        return seal_to(initial_data, self.public.depot) if self._seals and self.public.depot else initial_data

    def agent(self, agent_id: int, life: int, now: float) -> Callable[..., SecuredOwnAgent]:
        """What makes the agent of a life that begins `now`, in mission seconds; lives are counted from 1."""

        def keep(bundle: Bundle) -> None:
            self._bundles[agent_id] = bundle

        boot = boot_of(round(now * MICROSECONDS) + life, _of_seed(self._seed, f"boot {agent_id} {life}")[:8])
        bundle = self._bundles[agent_id]
        session = Session(bundle, boot, keep, self._verified)
        return partial(SecuredOwnAgent, session, seal=seal_of(bundle) if self._seals else None)


def _of_seed(seed: int, what: str) -> bytes:
    """32 bytes that everybody who knows the seed can work out: keys of a simulated mission are no secrets."""
    return hashlib.sha256(f"{what} of seed {seed}".encode()).digest()
