"""What an event handler is: one of Algorithms 1-20, and all that it declares.

A handler declares the branches that it can take, the messages that it may send, the timers that it may start and the
local events that it may trigger. `ucp.core` holds it to that, and `docs.generate.handlers` draws the protocol from it.
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
"""What happens inside an agent (Figure 3.3: the parallelograms), by its name in the thesis."""


@dataclass(frozen=True, eq=False)
class EventHandler(Generic[P]):
    """`run` is given the agent's core, then its input; it returns the branch that it took."""

    name: str
    run: Callable[P, str]
    algorithm: int
    branches: tuple[str, ...]
    sends: tuple[type[Message], ...]
    starts: tuple[str, ...]
    triggers: tuple[LocalEvent, ...]
    tally: str | None = None
    """Name of the part of the state that it counts in, or into which it puts what it chooses."""

    @property
    def title(self) -> str:
        """Number and name of the algorithm, as a good handler's docstring begins."""
        algorithm = re.match(rf"Algorithm ({self.algorithm}), (\w[\w ]+\w)", self.run.__doc__ or "")
        assert algorithm, f"{self.name} says which algorithm it is"
        return " ".join(algorithm.groups())


def event_handler(
    algorithm: int,
    *branches: str,
    sends: tuple[type[Message], ...] = (),
    starts: tuple[str, ...] = (),
    triggers: tuple[LocalEvent, ...] = (),
    tally: str | None = None,
) -> Callable[[Callable[P, str]], EventHandler[P]]:
    """Declare a function to be the handler of Algorithm `algorithm`, and the most that it does.

    `branches` are those that it returns; `starts` names timers, `tally` what of the state it counts in, or chooses.
    """

    def declare(run: Callable[P, str]) -> EventHandler[P]:
        return EventHandler(run.__name__, run, algorithm, branches, sends, starts, triggers, tally)

    return declare
