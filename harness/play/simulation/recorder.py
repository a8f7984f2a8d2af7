"""Who takes down what happens in virtual time and cannot be asked for at the end."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from netem.radio import Place
from ucp.trace import Entry

if TYPE_CHECKING:
    from harness.play.simulation.backend import Simulation
    from harness.play.simulation.lives import Incarnation


class Recorder(Protocol):
    tracing: bool
    """Whether handler runs are wanted; if not, `write` is not called."""

    def begin(self, life: "Incarnation") -> None:
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

    def keep_chains(self, simulation: "Simulation") -> None:
        """A final reconcile is about to put the chains in order."""

    def export(self, simulation: "Simulation") -> None:
        """Somebody wants to see the chains as they are now. Raises OSError."""
