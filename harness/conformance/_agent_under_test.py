"""An agent under test and its mission."""

import base64
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from harness.conformance._alphabet import INPUTS, TIMER, Input
from harness.conformance._observation import Exchange, Seen
from harness.conformance._reference_model import AGENT, INITIAL_DATA, ROSTER, Model
from harness.conformance._state_space import Variant, pair_of, state_of
from harness.play.process.agent_mission import NO_QUIRKS
from ucp.features import CONTRACT
from ucp.mission import SCHEMA


class Subject(ABC):
    """One life of an agent."""

    def __init__(self, variant: Variant) -> None:
        self.model = Model(variant.settings)
        self.in_step = True
        """Whether the reference still is where the agent is, after the machine was late."""

    async def step(self, given: Input) -> Seen | None:
        """Both are given an input, and compared; None if there is no such input now."""
        if given.first is None:
            return await self._step(given)
        pair = pair_of(state_of(self.model), given)
        before = await self._step(INPUTS[given.first])
        if before is None or before.wrong:
            return before
        then = await self._step(INPUTS[TIMER])
        return then if then is None else replace(then, pair=pair, hidden=before.outcome.runs[0])

    @abstractmethod
    async def _step(self, given: Input) -> Seen | None: ...

    @property
    @abstractmethod
    def hurried(self) -> bool:
        """Whether the next timer ends so soon that no input should be given before."""

    @abstractmethod
    def exchanges(self) -> tuple[Exchange, ...]:
        """All that has crossed the air."""

    @abstractmethod
    async def close(self) -> None:
        """End it."""


Start = Callable[[Variant, bool], Awaitable[Subject]]
"""Starts an agent in a mission with such settings, alone or beside others.

Raises NoAgentError, UnsupportedError, AgentEndedError."""


NO_KEYS: Mapping[str, Any] = MappingProxyType({})


def mission(
    variant: Variant, *, address: str, broadcast: str, port: int, speedup: float, keys: Mapping[str, Any] = NO_KEYS
) -> dict[str, Any]:
    """`keys` take the place of those that are here."""
    return {
        "schema": SCHEMA,
        "contract": CONTRACT,
        "features": list(variant.features),
        "agent_id": AGENT,
        "roster": list(ROSTER),
        "initial_data": base64.b64encode(INITIAL_DATA).decode("ascii"),
        "network": {"address": address, "broadcast": broadcast, "port": port},
        "events": {
            "source": "none",
            "mean_s": 30.0,
            "position_interval_s": 10.0,
            "log": ["mode", "arming", "text", "position"],
            "vehicle_host": "127.0.0.1",
            "vehicle_port": 5762,
        },
        "settings": variant.settings.to_json(),
        "quirks": dict(NO_QUIRKS),
        "seed": 1,
        "speedup": speedup,
        "epoch_us": None,
        "store": None,
        **keys,
    }
