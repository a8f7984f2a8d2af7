"""Define a quirk: a deliberate error that replaces a correct handler, or an operation of the agent, by a wrong one.

    @quirk(4)
    def count_votes_twice(good: Handler, core: Core, sender: int, message: BlockAddResponse) -> str:
        '''If a vote arrives twice, both copies count.'''
        core.voters.discard(sender)
        return good(core, sender, message)

    @quirk(5, helper=Core.send)
    def hide_commits(good: Helper, core: Core, message: CommitBlock) -> None:
        '''The agent commits its approved block and sends no Commit Block.'''

The first quirk replaces the handler of Algorithm 4. `good` is the replaced handler. The second quirk replaces
`Core.send`, but only while the handler of Algorithm 5 runs. `good` may already be wrong, so several quirks of one
Algorithm can be combined. The good handlers and the core contain no code for quirks.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from ucp.core import Core
from ucp.handler import EventHandler, LocalEvent
from ucp.messages import Message
from ucp.short_value import shown

Handler = Callable[..., str]
"""The type of a handler that a quirk replaces. Its arguments are the core and the input of the handler."""
Helper = Callable[..., None]
"""The type of a method of the core that a quirk replaces. Its arguments are the core and the arguments of the
method.
"""

CRASHED = "crashed by quirk"
"""The branch of a wrong handler that raised an exception. The effects before the exception stay."""


@dataclass(frozen=True, eq=False)
class Quirk:
    """A deliberate error. `wrong` replaces the handlers of `algorithms`, or the operation `helper` in these handlers.

    `branches`, `sends`, `starts` and `triggers` list the branches, messages, timers and events that the wrong handlers
    use, but the good handlers do not use. If `chance` is true, the value of the quirk is a probability 0..1, and
    `wrong` receives a function that draws whether the mistake occurs. Otherwise the value is true or false.
    """

    name: str
    sentence: str
    """A description of the mistake."""
    algorithms: tuple[int, ...]
    wrong: Callable[..., Any]
    helper: str | None
    branches: tuple[str, ...]
    sends: tuple[type[Message], ...]
    starts: tuple[str, ...]
    triggers: tuple[LocalEvent, ...]
    chance: bool

    def check(self, value: object) -> None:
        """Raise ValueError if this deliberate error cannot have this value. The message is one sentence."""
        if not self.chance:
            if not isinstance(value, bool):
                raise ValueError(f"{self.name} must be true or false, not {shown(value)}")
        elif isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
            raise ValueError(f"{self.name} must be a probability 0..1, not {shown(value)}")

    def wrong_handler(self, good: EventHandler[Any], value: float, rng: Random) -> EventHandler[Any]:
        """Return a wrong handler that replaces `good`. The wrong handler draws random numbers from `rng`."""
        return replace(
            good,
            run=self._run(good.run, value, rng),
            branches=good.branches + self.branches,
            sends=good.sends + self.sends,
            starts=good.starts + self.starts,
            triggers=good.triggers + self.triggers,
        )

    def _run(self, good: Handler, value: float, rng: Random) -> Handler:
        if self.helper is not None:
            return self._run_with_wrong_helper(good, self.helper)
        chance = {"occurs": lambda: rng.random() < value} if self.chance else {}

        def run(core: Core, *inputs: object) -> str:
            branch: str = self.wrong(good, core, *inputs, **chance)
            return branch

        return run

    def _run_with_wrong_helper(self, good: Handler, helper: str) -> Handler:
        wrong_cores: dict[type[Core], type[Core]] = {}

        def wrong_core(right_core: type[Core]) -> type[Core]:
            def method(core: Core, *arguments: object) -> object:
                return self.wrong(getattr(right_core, helper), core, *arguments)

            return type(right_core.__name__, (right_core,), {"__slots__": (), helper: method})

        def run(core: Core, *inputs: object) -> str:
            right_core = type(core)
            if right_core not in wrong_cores:
                wrong_cores[right_core] = wrong_core(right_core)
            core.__class__ = wrong_cores[right_core]
            try:
                return good(core, *inputs)
            finally:
                core.__class__ = right_core

        return run


def quirk(
    *algorithms: int,
    helper: Callable[..., Any] | None = None,
    branches: tuple[str, ...] = (),
    sends: tuple[type[Message], ...] = (),
    starts: tuple[str, ...] = (),
    triggers: tuple[LocalEvent, ...] = (),
    chance: bool = False,
) -> Callable[[Callable[..., Any]], Quirk]:
    """Return a decorator that declares a function as a deliberate error. Its docstring becomes the description."""

    def declare(wrong: Callable[..., Any]) -> Quirk:
        sentence = " ".join((wrong.__doc__ or "").split())
        assert sentence, f"the docstring of {wrong.__name__} describes its mistake"
        name = helper.__name__ if helper is not None else None
        return Quirk(wrong.__name__, sentence, algorithms, wrong, name, branches, sends, starts, triggers, chance)

    return declare


def catch_exceptions(handler: EventHandler[Any]) -> EventHandler[Any]:
    """Return a handler that also has a branch for exceptions.

    An exception ends the handler run, and the agent continues, as in the field tests of the thesis.
    """

    def run(core: Core, *inputs: object) -> str:
        try:
            return handler.run(core, *inputs)
        except Exception:
            return CRASHED

    return replace(handler, run=run, branches=(*handler.branches, CRASHED))
