"""Define the interface of engines. An engine makes the kernel apply network conditions to packets, and reports the
result.

There are two engines: `netem.tc` (tc-netem(8)) and `netem._nft` (nft(8)). For each receiver, both report the kernel's
counts of three kinds of packets: passed, lost, and dropped by a partition. The counts begin at 0 when the lab starts,
and a change of conditions does not reset them.

After each change, the engine reads the state of the kernel. A difference from the requested conditions is an error, and
the previous conditions are restored. A packet that is already in a queue during a change arrives under the old
conditions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar

from netem._fabric import VirtualSwitch
from netem.conditions import NetworkConditions
from netem.errors import EngineError
from netem.link import GilbertElliott, LinkConditions

RESOLUTION = 1.5e-9
"""Precision of probabilities and of delays in seconds. Engines store probabilities as fractions of 2^32-1 or 10^9, and
delays in nanoseconds.
"""
RATE_RESOLUTION = 4.01
"""Precision of rates, in bits per second. Engines store rates in whole bytes per second."""

_COUNTS = ("passed", "lost", "cut")
_MAX_WORDS = 600  # characters of conditions in an error message


@dataclass(frozen=True)
class ReceiverFigures:
    """The network conditions and packet counters that the kernel reports for one receiver.

    `link` applies to all senders except those in `links`. `cut_from` lists the senders that a partition separates.
    `passed`, `lost` (by chance or because of a full queue) and `cut` (by a partition) count packets since the start of
    the lab. A broadcast counts once for each receiver. A duplicate counts again. A packet in transit does not count
    yet.
    """

    link: LinkConditions
    links: Mapping[int, LinkConditions]
    cut_from: tuple[int, ...]
    passed: int
    lost: int
    cut: int

    @classmethod
    def of(cls, held: Mapping[int, LinkConditions], cut_from: tuple[int, ...], *counts: int) -> ReceiverFigures:
        """Create the object for one receiver. `held` maps each sender to the network conditions of its packets. The
        conditions that occur most often become `link`.
        """
        ((usual, _),) = Counter(held.values()).most_common(1) or [(LinkConditions(), 0)]
        differing = {sender: link for sender, link in held.items() if link != usual}
        return cls(usual, differing, cut_from, *counts)

    @property
    def loss(self) -> float | GilbertElliott:
        """The loss of `link`: a probability, or a model of loss in bursts."""
        return self.link.loss

    def from_sender(self, sender: int) -> LinkConditions:
        """Return the network conditions for packets of this sender, without considering the partition."""
        return self.links.get(sender, self.link)

    def to_json(self) -> dict[str, Any]:
        links = {str(sender): link.to_json() for sender, link in self.links.items()}
        counts = {key: getattr(self, key) for key in _COUNTS}
        return {**self.link.to_json(), **({"links": links} if links else {}), "cut_from": self.cut_from, **counts}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> ReceiverFigures:
        """Create the object from a JSON object in the format of `to_json`."""
        own = {field.name for field in fields(cls)}
        return cls(
            LinkConditions.from_json({key: figure for key, figure in value.items() if key not in own}),
            {int(sender): LinkConditions.from_json(link) for sender, link in value.get("links", {}).items()},
            tuple(value["cut_from"]),
            *(value[key] for key in _COUNTS),
        )


@dataclass(frozen=True)
class AppliedConditions:
    """The state of the network as the kernel reports it."""

    engine: str
    receivers: Mapping[int, ReceiverFigures]

    def to_json(self) -> dict[str, Any]:
        figures = {str(vehicle): figures.to_json() for vehicle, figures in self.receivers.items()}
        return {"engine": self.engine, "receivers": figures}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> AppliedConditions:
        """Create the object from a JSON object in the format of `to_json`."""
        figures = {int(vehicle): ReceiverFigures.from_json(entry) for vehicle, entry in value["receivers"].items()}
        return cls(value["engine"], figures)


class Engine(ABC):
    """A mechanism that applies network conditions at the ports of the virtual switch."""

    name: ClassVar[str]
    has_queues: ClassVar[bool]
    """True if the engine supports all network conditions. An engine with a false value supports only independent loss
    and partitions.
    """

    def __init__(self, fabric: VirtualSwitch) -> None:
        """Install the engine. At first it applies neither loss nor delay. Raises EngineError if the kernel does not
        support the engine.
        """
        self._fabric = fabric
        self._vehicles = fabric.vehicles
        self._in_force = NetworkConditions()

    @abstractmethod
    def change(self, conditions: NetworkConditions) -> None:
        """Request network conditions from the kernel. Raises EngineError with the kernel's message if the kernel
        refuses them.
        """

    @abstractmethod
    def read(self) -> AppliedConditions:
        """Return the network conditions and packet counters that the kernel reports."""

    def apply(self, conditions: NetworkConditions) -> AppliedConditions:
        """Change the network conditions. Return the state that the kernel reports afterwards.

        Raises ConditionsError for an unknown vehicle. Raises EngineError if the engine does not support the conditions,
        if the kernel refuses them, or if the state of the kernel differs from them. In these cases the previous
        conditions are restored, or the error names the conditions that now apply.
        """
        conditions.validate(self._vehicles)
        if not self.has_queues and (needs := conditions.needs()):
            raise EngineError(
                f"Engine {self.name} supports only loss and partitions, not {', '.join(needs)}; "
                "use engine netem or the simulation (--backend sim)"
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
                    f"{error}. Requested: {asked}. The previous conditions could not be restored ({second}); in "
                    f"effect: {held}"
                ) from error
            before = _in_brief(self._in_force.to_json())
            raise EngineError(
                f"{error}. Requested: {asked}; the previous conditions are in effect again: {before}"
            ) from error
        self._in_force = conditions
        return applied

    def _apply(self, conditions: NetworkConditions) -> AppliedConditions:
        self.change(conditions)
        applied = self.read()
        for receiver, figures in applied.receivers.items():
            cut_from = {sender for sender in self._vehicles if conditions.is_cut(sender, receiver)}
            if cut_from != set(figures.cut_from):
                raise EngineError(
                    f"The kernel does not cut off vehicle {receiver} as requested: requested from {sorted(cut_from)}, "
                    f"in effect from {sorted(figures.cut_from)}"
                )
            for sender in self._vehicles:
                if sender != receiver:
                    asked, held = conditions.link(sender, receiver), figures.from_sender(sender)
                    if differing := _differing(asked, held):
                        raise EngineError(
                            f"The kernel does not apply the requested {' and '.join(differing)} from vehicle "
                            f"{sender} to "
                            f"{receiver}: requested {asked.to_json()}, in effect {held.to_json()}"
                        )
        return applied


@lru_cache(maxsize=1 << 15)
def _differing(asked: LinkConditions, held: LinkConditions) -> tuple[str, ...]:
    """Return the keys of the network conditions whose values differ by more than the precision of an engine."""
    wanted, actual = _flat(asked.to_json()), _flat(held.to_json())
    if not (asked.delay and asked.delay.jitter_s and held.delay and held.delay.jitter_s):
        for flat in (wanted, actual):
            flat.pop("delay.distribution", None)  # meaningless without jitter
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
