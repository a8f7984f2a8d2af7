"""What an engine is: it makes the kernel do to packets what conditions say, and reports what it did.

Two engines stand behind this interface: `netem.tc` (tc-netem(8)) and `netem.nft` (nft(8)). Both count per
receiver, as the kernel does, every packet passed, lost by chance and cut off; counts live as long as the
lab and are not reset by a change. After every change the kernel is asked what it holds, and a difference
to what was asked is an error, not a note.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from netem.conditions import NetworkConditions
from netem.errors import EngineError
from netem.fabric import Fabric

# Engines hold probabilities as fractions of 2^32-1 or 10^9; finer than this nothing is promised.
RESOLUTION = 1e-9


@dataclass(frozen=True)
class ReceiverFigures:
    """What the kernel holds and has counted on the way to one vehicle.

    `loss` is a probability, `cut_from` the senders that a partition keeps away; `passed`, `lost` and
    `cut` are packets since the lab came up (a broadcast counts once for every receiver).
    """

    loss: float
    cut_from: tuple[int, ...]
    passed: int
    lost: int
    cut: int


@dataclass(frozen=True)
class Applied:
    """The state of the air as read back from the kernel."""

    engine: str
    receivers: Mapping[int, ReceiverFigures]

    def to_json(self) -> dict[str, Any]:
        figures = {str(vehicle): asdict(figures) for vehicle, figures in self.receivers.items()}
        return {"engine": self.engine, "receivers": figures}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Applied:
        """The inverse of `to_json`."""
        return cls(
            value["engine"],
            {
                int(vehicle): ReceiverFigures(**{**figures, "cut_from": tuple(figures["cut_from"])})
                for vehicle, figures in value["receivers"].items()
            },
        )


class Engine(ABC):
    """Applies conditions at the switch ports of a fabric."""

    name: ClassVar[str]

    def __init__(self, fabric: Fabric) -> None:
        """Install the engine with perfect conditions; raises EngineError where the kernel cannot."""
        self._fabric = fabric
        self._vehicles = fabric.vehicles

    @abstractmethod
    def change(self, conditions: NetworkConditions) -> None:
        """Ask the kernel for the conditions; raises EngineError with its own word if it refuses."""

    @abstractmethod
    def read(self) -> Applied:
        """Ask the kernel what it holds and has counted."""

    def apply(self, conditions: NetworkConditions) -> Applied:
        """Change the conditions and return what the kernel then holds.

        Raises ConditionsError for an unknown vehicle, EngineError if engines cannot do it, or if the
        kernel refuses or holds something else than asked.
        """
        conditions.validate(self._vehicles)
        if needs := conditions.needs():
            raise EngineError(
                f"Engine {self.name} knows loss per receiver and partitions, not yet {', '.join(needs)}; "
                "the simulation does (--backend sim)"
            )
        try:
            self.change(conditions)
        except EngineError as error:
            held = _describe(self.read())
            raise EngineError(f"{error}. Asked: {conditions.to_json()}; in force: {held}") from error
        applied = self.read()
        for receiver, figures in applied.receivers.items():
            loss = conditions.link(receiver, receiver).independent_loss
            cut_from = tuple(s for s in self._vehicles if conditions.is_cut(s, receiver))
            if abs(figures.loss - loss) > RESOLUTION or set(figures.cut_from) != set(cut_from):
                raise EngineError(
                    f"The kernel does not hold what was asked for vehicle {receiver}: asked loss {loss:g} and "
                    f"cut from {list(cut_from)}, in force loss {figures.loss:g} and cut from "
                    f"{list(figures.cut_from)}"
                )
        return applied


def _describe(applied: Applied) -> dict[int, dict[str, Any]]:
    return {v: {"loss": f.loss, "cut_from": list(f.cut_from)} for v, f in applied.receivers.items()}
