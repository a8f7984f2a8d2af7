"""Who takes down what happens in virtual time and cannot be asked for at the end."""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from harness.play.simulation.incarnations import Incarnation
from netem.radio import Place
from ucp.trace import Entry


class Recorder(Protocol):
    tracing: bool
    """Whether handler runs are wanted; if not, `write` is not called."""

    def begin(self, life: Incarnation) -> None:
        """An agent starts, or starts anew."""

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """An agent is about to log an event with so much data."""

    def write(self, agent_id: int, entries: list[Entry]) -> None: ...

    def changed(self, record: dict[str, Any]) -> None:
        """A change of the network, or a fault of agents, was made."""

    def injected(self, record: dict[str, Any]) -> None:
        """The rogue node has sent something; see `harness.play.rogue.journal`."""

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Here are the vehicles now, if any fly."""

    def keep_chains(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        """A final reconcile is about to put the chains of these agents in order."""

    def export(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        """Somebody wants to see the chains of these agents as they are now. Raises OSError."""
