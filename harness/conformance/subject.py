"""An agent under test, and what it should be, whichever way it is driven."""

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from dataclasses import replace

from harness.conformance.alphabet import INPUTS, TIMER, Input
from harness.conformance.observation import Exchange, Seen
from harness.conformance.reference_model import Model
from harness.conformance.state_space import Variant, pair_of, state_of


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
