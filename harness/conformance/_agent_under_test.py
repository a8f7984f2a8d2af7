"""Define the interface of an agent under test, and its mission."""

import base64
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from harness.conformance._alphabet import INPUTS, TIMER, AgentInput
from harness.conformance._observation import RecordedDatagram, TestedStep
from harness.conformance._reference_model import AGENT, INITIAL_DATA, ROSTER, ReferenceModel
from harness.conformance._state_space import SettingsVariant, key_of, state_of
from harness.play.process.agent_mission import NO_QUIRKS
from ucp.features import CONTRACT
from ucp.mission import SCHEMA


class AgentUnderTest(ABC):
    """An agent under test from its start to its end, and the reference implementation that gets the same inputs."""

    def __init__(self, variant: SettingsVariant) -> None:
        self.model = ReferenceModel(variant.settings)
        self.reference_follows = True
        """True while the reference implementation is in the same state as the agent. A slow machine can make this
        impossible.
        """

    async def step(self, given: AgentInput) -> TestedStep | None:
        """Give an input to the agent and to the reference. Return the comparison of their behaviour.

        Return None if the input is impossible in the current state.
        """
        if given.preceding is None:
            return await self._step(given)
        key = key_of(state_of(self.model), given)
        before = await self._step(INPUTS[given.preceding])
        if before is None or before.wrong:
            return before
        then = await self._step(INPUTS[TIMER])
        return then if then is None else replace(then, key=key, hidden_run=before.outcome.runs[0])

    @abstractmethod
    async def _step(self, given: AgentInput) -> TestedStep | None: ...

    @property
    @abstractmethod
    def timer_is_near(self) -> bool:
        """True if the agent's next timer expires so soon that no other input can come before it."""

    @abstractmethod
    def exchanges(self) -> tuple[RecordedDatagram, ...]:
        """Return all datagrams that the agent sent or received since its start."""

    @abstractmethod
    async def close(self) -> None:
        """End the agent, or make its process available for the next test."""


Start = Callable[[SettingsVariant, bool], Awaitable[AgentUnderTest]]
"""A function that starts an agent with a combination of settings. The second argument is true for the repetition of a
test, when few agents run in parallel. Raises NoAgentError, UnsupportedError, AgentEndedError.
"""


NO_KEYS: Mapping[str, Any] = MappingProxyType({})


def mission(
    variant: SettingsVariant,
    *,
    address: str,
    broadcast: str,
    port: int,
    speedup: float,
    keys: Mapping[str, Any] = NO_KEYS,
) -> dict[str, Any]:
    """Return a mission file for the agent. `keys` contains additional keys of the file, and keys with other values."""
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
