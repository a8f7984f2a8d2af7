"""What an event handler is: one of Algorithms 1-20, and the branches that it can take."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Concatenate, Generic, ParamSpec

if TYPE_CHECKING:
    from ucp.agent import Agent

P = ParamSpec("P")


@dataclass(frozen=True, eq=False)
class EventHandler(Generic[P]):
    """A handler changes the agent, tells it what to send and trigger, and returns the branch that it took."""

    name: str
    run: "Callable[Concatenate[Agent, P], str]"
    algorithm: int
    branches: tuple[str, ...]


def event_handler(
    algorithm: int, *branches: str
) -> "Callable[[Callable[Concatenate[Agent, P], str]], EventHandler[P]]":
    """Declare a function to be the handler of Algorithm `algorithm`, and the only branches that it returns."""

    def declare(run: "Callable[Concatenate[Agent, P], str]") -> EventHandler[P]:
        return EventHandler(run.__name__, run, algorithm, branches)

    return declare
