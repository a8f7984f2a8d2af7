"""A quirk: one mistake of an implementation. A few lines replace a good handler, or a method of the core.

    @quirk(4)
    def count_votes_twice(good: Handler, core: Core, sender: int, message: BlockAddResponse) -> str:
        '''If a vote arrives twice, both copies count.'''
        core.voters.discard(sender)
        return good(core, sender, message)

    @quirk(5, helper=Core.send)
    def hide_commits(good: Helper, core: Core, message: CommitBlock) -> None:
        '''The agent commits its approved block and sends no Commit Block.'''

The first replaces the handler of Algorithm 4. `good` is the replaced handler. The second replaces `Core.send`, and only
for Algorithm 5. `good` may itself be wrong, so quirks of one Algorithm add up. The good handlers and the core do not
know of quirks.
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
"""A replaced handler. Its arguments are the core and its input."""
Helper = Callable[..., None]
"""A replaced method of the core. Its arguments are the core and those of the method."""

CRASHED = "crashed by quirk"
"""The branch of a wrong handler that raised an exception. Its earlier effects stay."""


@dataclass(frozen=True, eq=False)
class Quirk:
    """`wrong` replaces the handlers of `algorithms`, or the core's method `helper` for these handlers.

    In addition to those of the good handlers, it may take `branches`, send, start and trigger. With `chance` its value
    is a probability 0..1, and it receives a function that draws whether the mistake occurs. Otherwise it is on or off.
    """

    name: str
    sentence: str
    """The mistake of the agent."""
    algorithms: tuple[int, ...]
    wrong: Callable[..., Any]
    helper: str | None
    branches: tuple[str, ...]
    sends: tuple[type[Message], ...]
    starts: tuple[str, ...]
    triggers: tuple[LocalEvent, ...]
    chance: bool

    def check(self, value: object) -> None:
        """Raises ValueError, in a sentence, if the quirk cannot have this value."""
        if not self.chance:
            if not isinstance(value, bool):
                raise ValueError(f"{self.name} is true or false, not {shown(value)}")
        elif isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
            raise ValueError(f"{self.name} is a probability 0..1, not {shown(value)}")

    def in_place_of(self, good: EventHandler[Any], value: float, lots: Random) -> EventHandler[Any]:
        """Return the wrong handler. It draws random numbers from `lots`."""
        return replace(
            good,
            run=self._run(good.run, value, lots),
            branches=good.branches + self.branches,
            sends=good.sends + self.sends,
            starts=good.starts + self.starts,
            triggers=good.triggers + self.triggers,
        )

    def _run(self, good: Handler, value: float, lots: Random) -> Handler:
        if self.helper is not None:
            return self._run_with_wrong_helper(good, self.helper)
        chance = {"strikes": lambda: lots.random() < value} if self.chance else {}

        def run(core: Core, *inputs: object) -> str:
            branch: str = self.wrong(good, core, *inputs, **chance)
            return branch

        return run

    def _run_with_wrong_helper(self, good: Handler, helper: str) -> Handler:
        wrong_cores: dict[type[Core], type[Core]] = {}

        def wrong_core(right: type[Core]) -> type[Core]:
            def method(core: Core, *arguments: object) -> object:
                return self.wrong(getattr(right, helper), core, *arguments)

            return type(right.__name__, (right,), {"__slots__": (), helper: method})

        def run(core: Core, *inputs: object) -> str:
            right = type(core)
            if right not in wrong_cores:
                wrong_cores[right] = wrong_core(right)
            core.__class__ = wrong_cores[right]
            try:
                return good(core, *inputs)
            finally:
                core.__class__ = right

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
    """Make a function a quirk of these Algorithms. The quirk takes its name and docstring."""

    def declare(wrong: Callable[..., Any]) -> Quirk:
        sentence = " ".join((wrong.__doc__ or "").split())
        assert sentence, f"{wrong.__name__} says what it does wrong"
        name = helper.__name__ if helper is not None else None
        return Quirk(wrong.__name__, sentence, algorithms, wrong, name, branches, sends, starts, triggers, chance)

    return declare


def ending_by_exceptions(handler: EventHandler[Any]) -> EventHandler[Any]:
    """The handler, which may raise: it then ends where it is, and the agent goes on, as in the thesis's field tests."""

    def run(core: Core, *inputs: object) -> str:
        try:
            return handler.run(core, *inputs)
        except Exception:
            return CRASHED

    return replace(handler, run=run, branches=(*handler.branches, CRASHED))
