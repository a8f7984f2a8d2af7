"""A fault: what happens to agents and their vehicles at an instant, as a value.

The class of a fault holds everything about it: its name in YAML, in records and in pytest, the states of an agent
before and after it, its effect on lives, vehicles and data, the calls to the backend, and the texts of the report.
Other modules ask the class and do not compare names. To add a fault, add a class to a file in this directory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field

from harness.scenario.strict_model import VehicleId
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import Circumstance

Agents = Annotated[list[VehicleId], Field(min_length=1)]
Disk = Literal["kept", "lost"]

RUNNING, PAUSED, KILLED, REBOOTING, SWITCHED_OFF = "running", "paused", "killed", "rebooting", "switched off"
"""States of an agent. A fault may lead to another, with a word of its own."""

CROSS = "M-5-5l10 10m0-10l-10 10"
BARS = "M-3-5v10M3-5v10"
ARROW = "M-4-5l9 5-9 5z"
DIAMOND = "M0-6l6 6-6 6-6-6z"
SQUARE = "M-5-5h10v10h-10z"
BAR = "M0-6v12"
"""Marks: SVG paths around the origin."""


class Lives(Protocol):
    """What a backend can do to an agent and its vehicle. None of it waits for mission time to pass."""

    async def end_life(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        """Destroy the agent, and with it its vehicle if asked; `disk_kept`: what it had stored is there later on."""

    async def begin_life(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        """Start the agent anew, with what is on its disk if that was kept, and on another vehicle if asked."""

    async def fall(self, agent_id: int) -> None:
        """Have the agent's vehicle fall to the ground, from now on."""

    async def pause(self, agent_id: int) -> None:
        """Have the agent stand still; what reaches it waits."""

    async def resume(self, agent_id: int) -> None: ...

    async def stop_logging(self, agent_id: int) -> None:
        """Have the agent log no more events in this life."""

    async def switch_off(self, agent_id: int) -> None:
        """Have the agent export its chain and end, and its vehicle with it."""

    async def reconcile(self, agent_id: int) -> None:
        """Have the agent begin a reconcile."""

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        """Have these vehicles hear, from the ground, that the agent's keys are revoked."""

    async def befall(self, agent_id: int, what: str, circumstance: Circumstance, *, by_hand: bool) -> None:
        """Have the agent's vehicle simulate this, `what` in words; whether it does is on record at the end."""


@dataclass(frozen=True)
class Fault:
    """At `at_s` mission seconds something happens to `agents`.

    Further fields of a subclass are keys of its timeline entry, each of which it needs; their annotations say what they
    may be. Fault itself is one of which nothing is known: it does nothing, and ends, takes and loses nothing.
    """

    at_s: float
    agents: tuple[int, ...]
    by_hand: bool = field(default=False, kw_only=True)
    """Somebody asked for it while the mission was played."""

    what: ClassVar[str] = ""
    """The key of a timeline entry, the word in records, and the verb in pytest."""
    is_asked_for: ClassVar[bool] = True
    """Whether it is a key of a timeline entry; otherwise it comes of another fault."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The states that an agent may be in before."""
    leads_to: ClassVar[str | None] = RUNNING
    """The state that it is in afterwards; None: the same."""
    needs_keys: ClassVar[bool] = False
    """Whether it is about keys, which only secured missions have."""
    ends_a_life: ClassVar[bool] = False
    """What the agent held in memory is gone."""
    begins_a_life: ClassVar[bool] = False
    takes_the_vehicle: ClassVar[bool] = False
    """The vehicle is out of the air, with all that the agent held."""
    leaves_an_export: ClassVar[bool] = False
    """The life ends in order: what the agent held by then is in its export, and not lost."""
    brings_a_vehicle: ClassVar[bool] = False
    """Another one, in the place of one that was taken."""
    stands_still: ClassVar[bool] = False
    """The agent lives and does nothing until the next fault."""
    stops_events: ClassVar[bool] = False
    """The agent logs nothing more in this life."""
    keys_in_words: ClassVar[str] = ""
    """What its further keys have to be, for whoever has left one out."""
    unless_told: ClassVar[Mapping[str, Any]] = {}
    """What its further keys are in pytest, where a test leaves them out."""
    mark: ClassVar[str] = ""
    """How the report's timeline shows it, an SVG path around the origin; without one it does not."""
    meaning: ClassVar[str] = ""
    """What the mark means; faults that mean the same share a mark."""

    async def strike(self, lives: Lives, agent_id: int) -> None:
        """Do it to one of the agents."""

    def course(self) -> "Sequence[Fault]":
        """All that happens to the agents by this entry of the timeline, in order."""
        return [self]

    def check(self, vehicles: Vehicles) -> None:
        """Raises ValueError, with what to do instead, if it cannot happen to such vehicles."""

    @property
    def also_named(self) -> Sequence[int]:
        """Vehicles that its further keys name."""
        return ()

    @property
    def disk_left(self) -> Disk | None:
        """What it leaves of the agents' disks; None if that is no question."""
        return None

    @classmethod
    def loses_data(cls, disk: Disk | None) -> bool:
        """Whether all that the agents held is gone, by what it left of their disks."""
        return cls.ends_a_life and not cls.leaves_an_export and disk != "kept"

    @classmethod
    def further_keys(cls) -> list[str]:
        """Its keys in a timeline entry, beside `at_s` and the one that names it."""
        return [field.name for field in fields(cls) if field.name not in Fault.__dataclass_fields__]

    @classmethod
    def told(cls, *agents: int, **further: Any) -> dict[str, Any]:
        """The verb in pytest: what a test says, as the keys of a timeline entry."""
        return {cls.what: list(agents), **cls.unless_told, **further}

    @property
    def detail(self) -> str:
        who = f"agent{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"
        return who if self.disk_left is None else f"{who}, disk {self.disk_left}"

    def to_json(self, at_s: float) -> dict[str, Any]:
        """The record of this fault, made at `at_s`."""
        record = {"at_s": at_s, "what": self.what, "detail": self.detail, "agents": list(self.agents)}
        hand = {"by_hand": True} if self.by_hand else {}
        return {**record, **({} if self.disk_left is None else {"disk": self.disk_left}), **hand}
