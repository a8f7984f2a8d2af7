"""The base class of all faults. A fault changes agents or their vehicles at one mission second.

The class of a fault holds everything about it: its name in YAML, in records and in pytest, the states of an agent
before and after it, its effect on agents, vehicles and data, the calls to the backend, and the texts of the report.
Other modules ask the class and do not compare names. To add a fault, add a class to a file in this directory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field

from harness.scenario.strict_model import VehicleId
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import Circumstance

AgentIds = Annotated[list[VehicleId], Field(min_length=1)]
DiskState = Literal["kept", "lost"]

RUNNING, PAUSED, KILLED, REBOOTING, SWITCHED_OFF = "running", "paused", "killed", "rebooting", "switched off"
"""States of an agent. A fault may define a further one."""

CROSS = "M-5-5l10 10m0-10l-10 10"
BARS = "M-3-5v10M3-5v10"
ARROW = "M-4-5l9 5-9 5z"
DIAMOND = "M0-6l6 6-6 6-6-6z"
SQUARE = "M-5-5h10v10h-10z"
BAR = "M0-6v12"
"""Marks: SVG paths around the origin."""


class AgentOperations(Protocol):
    """The operations of a backend on an agent and its vehicle. None of them waits for mission time to pass."""

    async def end_incarnation(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        """End the agent, and its vehicle if `with_vehicle` is true. `disk_kept` keeps the data on its disk."""

    async def begin_incarnation(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        """Start the agent again, with the kept data of its disk, and on a new vehicle if `new_vehicle` is true."""

    async def fall(self, agent_id: int) -> None:
        """Let the vehicle of the agent fall to the ground."""

    async def pause(self, agent_id: int) -> None:
        """Stop the agent. Its incoming messages wait."""

    async def resume(self, agent_id: int) -> None: ...

    async def stop_logging(self, agent_id: int) -> None:
        """Stop the event logging of the agent until it starts again."""

    async def switch_off(self, agent_id: int) -> None:
        """Make the agent export its chain, then end it and its vehicle."""

    async def reconcile(self, agent_id: int) -> None:
        """Make the agent start a reconcile."""

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        """Send the revocation of the agent's keys from the ground to the vehicles in `heard_by`."""

    async def set_circumstance(self, agent_id: int, what: str, circumstance: Circumstance, *, by_hand: bool) -> None:
        """Make the vehicle of the agent simulate a circumstance. The run record says whether it did."""


@dataclass(frozen=True)
class Fault:
    """A fault of `agents` at mission second `at_s`.

    Further fields of a subclass are keys of its timeline entry. The entry needs all of them. Their annotations declare
    the allowed values. `Fault` itself stands for an unknown fault and has no effect.
    """

    at_s: float
    agents: tuple[int, ...]
    by_hand: bool = field(default=False, kw_only=True)
    """True if a user requested the fault during the mission."""

    what: ClassVar[str] = ""
    """The key of a timeline entry, the word in records, and the verb in pytest."""
    is_timeline_key: ClassVar[bool] = True
    """True if the fault is a key of a timeline entry. False if another fault causes it."""
    states_before: ClassVar[tuple[str, ...]] = ()
    """States of an agent in which the fault is possible."""
    state_after: ClassVar[str | None] = RUNNING
    """State of the agent after the fault. None: unchanged."""
    needs_keys: ClassVar[bool] = False
    """True if the fault needs the keys of a secured mission."""
    ends_incarnation: ClassVar[bool] = False
    """The agent loses the data in its memory."""
    begins_incarnation: ClassVar[bool] = False
    removes_vehicle: ClassVar[bool] = False
    """The vehicle leaves the mission, with all data of the agent."""
    exports_chain: ClassVar[bool] = False
    """The agent exports its data before it ends. The data is not lost."""
    adds_vehicle: ClassVar[bool] = False
    """The agent gets a new vehicle."""
    suspends_agent: ClassVar[bool] = False
    """The agent stays alive but does nothing until the next fault."""
    stops_events: ClassVar[bool] = False
    """The agent logs no further events until it starts again."""
    keys_in_words: ClassVar[str] = ""
    """The further keys in words, for an error about a missing key."""
    key_descriptions: ClassVar[Mapping[str, str]] = {}
    """Further key -> its description for the scenario reference and the JSON Schema."""
    default_values: ClassVar[Mapping[str, Any]] = {}
    """Default values of the further keys in pytest."""
    mark: ClassVar[str] = ""
    """Mark in the timeline of the report: an SVG path around the origin. Without a mark, the report omits the fault."""
    meaning: ClassVar[str] = ""
    """Meaning of the mark. Faults with the same meaning share a mark."""

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        """Apply the fault to one of the agents."""

    def stages(self) -> "Sequence[Fault]":
        """Return all faults of this timeline entry, in time order."""
        return [self]

    def check(self, vehicles: Vehicles) -> None:
        """Raise ValueError if these vehicles cannot have the fault. The message names an alternative."""

    @property
    def further_vehicles(self) -> Sequence[int]:
        """Vehicle IDs in the further keys."""
        return ()

    @property
    def disk_after(self) -> DiskState | None:
        """State of the disks after the fault. None if the fault does not concern disks."""
        return None

    @classmethod
    def loses_data(cls, disk: DiskState | None) -> bool:
        """True if the agents lose all their data, given the state of their disks."""
        return cls.ends_incarnation and not cls.exports_chain and disk != "kept"

    @classmethod
    def further_keys(cls) -> list[str]:
        """Return the keys of its timeline entry besides `at_s` and the name of the fault."""
        return [field.name for field in fields(cls) if field.name not in Fault.__dataclass_fields__]

    @classmethod
    def entry_keys(cls, *agents: int, **further: Any) -> dict[str, Any]:
        """Return the keys of a timeline entry for the call of a test."""
        return {cls.what: list(agents), **cls.default_values, **further}

    @property
    def detail(self) -> str:
        agents = f"agent{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"
        return agents if self.disk_after is None else f"{agents}, disk {self.disk_after}"

    def to_json(self, at_s: float) -> dict[str, Any]:
        """The record of this fault, made at `at_s`."""
        record = {"at_s": at_s, "what": self.what, "detail": self.detail, "agents": list(self.agents)}
        hand = {"by_hand": True} if self.by_hand else {}
        disk = {} if self.disk_after is None else {"disk": self.disk_after}
        return {**record, **disk, **planned_key(self.at_s, at_s), **hand}


SAME_TIME_S = 0.001
"""Records round times to milliseconds."""


def planned_key(planned_s: float, at_s: float) -> dict[str, float]:
    """Return the key `planned_s` of a record, if the change was made later than planned."""
    return {} if abs(planned_s - at_s) < SAME_TIME_S else {"planned_s": planned_s}
