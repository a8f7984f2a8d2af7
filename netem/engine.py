"""What an engine is: it makes the kernel do to packets what conditions say, and reports what it did.

Two engines stand behind this interface: `netem.tc` (tc-netem(8)) and `netem._nft` (nft(8)). Both count per
receiver, as the kernel does, every packet passed, lost and cut off; counts live as long as the lab and are
not reset by a change. After every change the kernel is asked what it holds, and a difference to what was
asked is an error, not a note: the conditions before are then put back. Packets that are under way when
conditions change arrive as they would have.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar

from netem._fabric import Fabric
from netem.conditions import NetworkConditions
from netem.errors import EngineError
from netem.link import GilbertElliott, LinkConditions

RESOLUTION = 1.5e-9
"""Engines hold probabilities as fractions of 2^32-1 or 10^9 and delays in ns; finer than this nothing is promised."""
RATE_RESOLUTION = 4.01
"""Bits per second: rates are held in whole bytes per second."""

_COUNTS = ("passed", "lost", "cut")
_MAX_WORDS = 600  # characters of an error's account of conditions


@dataclass(frozen=True)
class ReceiverFigures:
    """What the kernel holds and has counted on the way to one vehicle.

    `link` is what happens to packets from all senders but those in `links`, and `cut_from` are the senders that a
    partition keeps away. `passed`, `lost` (by chance, or for want of room) and `cut` are packets since the lab came
    up: a broadcast counts once for every receiver, a duplicate as one more, a packet on its way not yet.
    """

    link: LinkConditions
    links: Mapping[int, LinkConditions]
    cut_from: tuple[int, ...]
    passed: int
    lost: int
    cut: int

    @classmethod
    def of(cls, held: Mapping[int, LinkConditions], cut_from: tuple[int, ...], *counts: int) -> ReceiverFigures:
        """From what is held for each sender; `counts` in the order of the fields."""
        ((usual, _),) = Counter(held.values()).most_common(1) or [(LinkConditions(), 0)]
        differing = {sender: link for sender, link in held.items() if link != usual}
        return cls(usual, differing, cut_from, *counts)

    @property
    def loss(self) -> float | GilbertElliott:
        """That of `link`."""
        return self.link.loss

    def from_sender(self, sender: int) -> LinkConditions:
        """What happens to a packet of this sender that is not cut off."""
        return self.links.get(sender, self.link)

    def to_json(self) -> dict[str, Any]:
        links = {str(sender): link.to_json() for sender, link in self.links.items()}
        counts = {key: getattr(self, key) for key in _COUNTS}
        return {**self.link.to_json(), **({"links": links} if links else {}), "cut_from": self.cut_from, **counts}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ReceiverFigures:
        """The inverse of `to_json`."""
        own = {field.name for field in fields(cls)}
        return cls(
            LinkConditions.from_json({key: figure for key, figure in value.items() if key not in own}),
            {int(sender): LinkConditions.from_json(link) for sender, link in value.get("links", {}).items()},
            tuple(value["cut_from"]),
            *(value[key] for key in _COUNTS),
        )


@dataclass(frozen=True)
class Applied:
    """The state of the air as read back from the kernel."""

    engine: str
    receivers: Mapping[int, ReceiverFigures]

    def to_json(self) -> dict[str, Any]:
        figures = {str(vehicle): figures.to_json() for vehicle, figures in self.receivers.items()}
        return {"engine": self.engine, "receivers": figures}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Applied:
        """The inverse of `to_json`."""
        figures = {int(vehicle): ReceiverFigures.from_json(entry) for vehicle, entry in value["receivers"].items()}
        return cls(value["engine"], figures)


class Engine(ABC):
    """Applies conditions at the switch ports of a fabric."""

    name: ClassVar[str]
    has_queues: ClassVar[bool]
    """Knows all conditions, not only independent loss and partitions."""

    def __init__(self, fabric: Fabric) -> None:
        """Install the engine with perfect conditions; raises EngineError where the kernel cannot."""
        self._fabric = fabric
        self._vehicles = fabric.vehicles
        self._in_force = NetworkConditions()

    @abstractmethod
    def change(self, conditions: NetworkConditions) -> None:
        """Ask the kernel for the conditions; raises EngineError with its own word if it refuses."""

    @abstractmethod
    def read(self) -> Applied:
        """Ask the kernel what it holds and has counted."""

    def apply(self, conditions: NetworkConditions) -> Applied:
        """Change the conditions and return what the kernel then holds.

        Raises ConditionsError for an unknown vehicle, EngineError if the engine cannot do it, or if the kernel
        refuses or holds something else than asked; the conditions before are then in force, or the error says
        what is.
        """
        conditions.validate(self._vehicles)
        if not self.has_queues and (needs := conditions.needs()):
            raise EngineError(
                f"Engine {self.name} knows loss and partitions, not {', '.join(needs)}; "
                "engine netem does, and the simulation (--backend sim)"
            )
        try:
            applied = self._apply(conditions)
        except EngineError as error:
            asked = _in_brief(conditions.to_json())
            try:
                self._apply(self._in_force)
            except EngineError as second:
                held = _in_brief(self.read().to_json()["receivers"])
                raise EngineError(
                    f"{error}. Asked: {asked}. The conditions before could not be put back ({second}); in force: {held}"
                ) from error
            before = _in_brief(self._in_force.to_json())
            raise EngineError(f"{error}. Asked: {asked}; in force again: {before}") from error
        self._in_force = conditions
        return applied

    def _apply(self, conditions: NetworkConditions) -> Applied:
        self.change(conditions)
        applied = self.read()
        for receiver, figures in applied.receivers.items():
            cut_from = {sender for sender in self._vehicles if conditions.is_cut(sender, receiver)}
            if cut_from != set(figures.cut_from):
                raise EngineError(
                    f"The kernel does not cut off vehicle {receiver} as asked: asked from {sorted(cut_from)}, "
                    f"in force from {sorted(figures.cut_from)}"
                )
            for sender in self._vehicles:
                if sender != receiver:
                    asked, held = conditions.link(sender, receiver), figures.from_sender(sender)
                    if differing := _differing(asked, held):
                        raise EngineError(
                            f"The kernel does not hold the {' and '.join(differing)} asked from vehicle {sender} to "
                            f"{receiver}: asked {asked.to_json()}, in force {held.to_json()}"
                        )
        return applied


@lru_cache(maxsize=1 << 15)
def _differing(asked: LinkConditions, held: LinkConditions) -> tuple[str, ...]:
    """The keys of what is held in other values than asked, beyond the resolution of engines."""
    wanted, actual = _flat(asked.to_json()), _flat(held.to_json())
    if not (asked.delay and asked.delay.jitter_s and held.delay and held.delay.jitter_s):
        for flat in (wanted, actual):
            flat.pop("delay.distribution", None)  # of what does not vary
    return tuple(key for key in wanted | actual if not _close(key, wanted.get(key, 0), actual.get(key, 0)))


def _close(key: str, asked: float | str, held: float | str) -> bool:
    if isinstance(asked, str) or isinstance(held, str):
        return asked == held
    return abs(asked - held) <= (RATE_RESOLUTION if key == "rate" else RESOLUTION)


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= _flat(item, f"{prefix}{key}.") if isinstance(item, Mapping) else {prefix + key: item}
    return flat


def _in_brief(value: object) -> str:
    words = str(value)
    return words if len(words) <= _MAX_WORDS else f"{words[:_MAX_WORDS]}…"
