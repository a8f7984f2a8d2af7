"""Define event handlers. An event handler is the function for one of Algorithms 1-20, together with its declarations. A
handler declares its branches, the messages that it may send, the timers that it may start, and the local events that it
may trigger. `ucp.core` enforces the declarations, and `docs.generate.handlers` draws the protocol from them.
"""

import re
from collections.abc import Callable
from typing import Generic, Literal, ParamSpec

from ucp._dataclass import dataclass
from ucp.messages import Message

P = ParamSpec("P")

LocalEvent = Literal[
    "Build Data Block",
    "Process Next Deque Block",
    "Reconcile Begin",
    "Reconcile Phase 1",
    "Reconcile Phase 2",
    "Reconcile Phase 3",
    "Reconcile Finalize",
]
"""Name of a local event in the thesis. A local event triggers a handler of the same agent (the parallelograms of Figure
3.3).
"""


@dataclass(frozen=True, eq=False)
class EventHandler(Generic[P]):
    """An event handler. `run` takes the state of the agent and the input, and returns the name of the branch it
    took.
    """

    name: str
    run: Callable[P, str]
    algorithm: int
    branches: tuple[str, ...]
    sends: tuple[type[Message], ...]
    starts: tuple[str, ...]
    triggers: tuple[LocalEvent, ...]
    tally: str | None = None
    """Name of the attribute of `AgentState` in which this handler counts votes or answers, or stores the chosen block.
    None for all other handlers.
    """

    @property
    def title(self) -> str:
        """Return the number and name of the Algorithm. The first words of the handler's docstring contain both."""
        algorithm = re.match(rf"Algorithm ({self.algorithm}), (\w[\w ]+\w)", self.run.__doc__ or "")
        assert algorithm, f"the docstring of {self.name} begins with its algorithm"
        return " ".join(algorithm.groups())


def event_handler(
    algorithm: int,
    *branches: str,
    sends: tuple[type[Message], ...] = (),
    starts: tuple[str, ...] = (),
    triggers: tuple[LocalEvent, ...] = (),
    tally: str | None = None,
) -> Callable[[Callable[P, str]], EventHandler[P]]:
    """Return a decorator that declares a function as the handler of Algorithm `algorithm`. `branches` contains all
    values that the function may return. `sends`, `starts` and `triggers` contain the messages, timers and local events
    that it may use. `tally` is the name of the state attribute with the counters or the choice of the handler.
    """

    def declare(run: Callable[P, str]) -> EventHandler[P]:
        return EventHandler(run.__name__, run, algorithm, branches, sends, starts, triggers, tally)

    return declare
