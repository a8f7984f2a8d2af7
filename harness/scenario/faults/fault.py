"""The base class of all faults. A fault changes agents or their vehicles at one moment of the mission.

The class of a fault defines all properties of the fault:

- its name in YAML, in records and in pytest
- the states of an agent before and after the fault
- its effect on agents, vehicles and data
- the calls to the backend
- the texts of the report

Other modules read these properties, and do not compare names. To add a fault, add a class to a file in this directory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field

from harness.scenario.strict_model import VehicleId
from harness.scenario.vehicles import Vehicles
from sitl.circumstances import SimulatedFailure

AgentIds = Annotated[list[VehicleId], Field(min_length=1)]
DiskState = Literal["kept", "lost"]

RUNNING, PAUSED, KILLED, REBOOTING, SWITCHED_OFF = "running", "paused", "killed", "rebooting", "switched off"
"""The states that an agent can have. A fault may define a further state."""

CROSS = "M-5-5l10 10m0-10l-10 10"
BARS = "M-3-5v10M3-5v10"
ARROW = "M-4-5l9 5-9 5z"
DIAMOND = "M0-6l6 6-6 6-6-6z"
SQUARE = "M-5-5h10v10h-10z"
BAR = "M0-6v12"
"""A mark for the timeline of the report: an SVG path around the origin."""


class AgentOperations(Protocol):
    """The operations on an agent and its vehicle that a backend must provide. None of them waits for mission time to
    pass.
    """

    async def end_incarnation(self, agent_id: int, *, with_vehicle: bool = False, disk_kept: bool = False) -> None:
        """End the agent, and also its vehicle if `with_vehicle` is true. If `disk_kept` is true, the data on its disk
        are kept.
        """

    async def begin_incarnation(self, agent_id: int, *, new_vehicle: bool = False) -> None:
        """Restart the agent with the data on its disk. If `new_vehicle` is true, the agent gets a new vehicle."""

    async def fall(self, agent_id: int) -> None:
        """Let the vehicle of the agent fall to the ground."""

    async def pause(self, agent_id: int) -> None:
        """Stop the agent temporarily. Messages to the agent wait."""

    async def resume(self, agent_id: int) -> None: ...

    async def stop_logging(self, agent_id: int) -> None:
        """Make the agent log no further events until its next start."""

    async def switch_off(self, agent_id: int) -> None:
        """Let the agent export its chain, and then end it and its vehicle."""

    async def reconcile(self, agent_id: int) -> None:
        """Let the agent start a reconcile."""

    async def revoke(self, agent_id: int, heard_by: Sequence[int]) -> None:
        """Send a message from the ground that excludes the agent. The vehicles in `heard_by` receive it."""

    async def set_circumstance(
        self, agent_id: int, what: str, circumstance: SimulatedFailure, *, by_hand: bool
    ) -> None:
        """Let the vehicle of the agent simulate an event such as a GPS failure. The run record states whether this was
        possible.
        """


@dataclass(frozen=True)
class Fault:
    """A fault of the agents `agents` at mission second `at_s`.

    Further fields of a subclass are keys of its timeline entry. All of these fields are required. The annotations of
    the fields declare the allowed values. The class `Fault` itself represents an unknown fault, which has no effect.
    """

    at_s: float
    agents: tuple[int, ...]
    by_hand: bool = field(default=False, kw_only=True)
    """True if a user requested the fault during the mission."""

    what: ClassVar[str] = ""
    """The name of the fault: the key of a timeline entry, the word in records, and the verb in pytest."""
    is_timeline_key: ClassVar[bool] = True
    """True if the fault is a key of a timeline entry. False if another fault causes it."""
    states_before: ClassVar[tuple[str, ...]] = ()
    """States of an agent in which the fault is possible."""
    state_after: ClassVar[str | None] = RUNNING
    """State of the agent after the fault. None if the state does not change."""
    needs_keys: ClassVar[bool] = False
    """True if the fault needs the keys of a secured mission."""
    ends_incarnation: ClassVar[bool] = False
    """True if the agent loses the data in its memory."""
    begins_incarnation: ClassVar[bool] = False
    removes_vehicle: ClassVar[bool] = False
    """True if the vehicle leaves the mission, together with all data of the agent."""
    exports_chain: ClassVar[bool] = False
    """True if the agent exports its data before it ends, so that the data is not lost."""
    adds_vehicle: ClassVar[bool] = False
    """True if the agent gets a new vehicle."""
    suspends_agent: ClassVar[bool] = False
    """True if the agent stays alive but does nothing until the next fault."""
    stops_events: ClassVar[bool] = False
    """True if the agent logs no further events until it starts again."""
    keys_in_words: ClassVar[str] = ""
    """The names of the further keys as text, for an error about a missing key."""
    key_descriptions: ClassVar[Mapping[str, str]] = {}
    """Further key -> its description for the scenario reference and the JSON Schema."""
    default_values: ClassVar[Mapping[str, Any]] = {}
    """Default values of the further keys in pytest."""
    mark: ClassVar[str] = ""
    """Mark in the timeline of the report: an SVG path around the origin. Without a mark, the report omits the fault."""
    meaning: ClassVar[str] = ""
    """Meaning of the mark. Faults with the same meaning share a mark."""

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        """Apply the fault to this agent."""

    def stages(self) -> "Sequence[Fault]":
        """Return all faults that this timeline entry causes, in order of time."""
        return [self]

    def check(self, vehicles: Vehicles) -> None:
        """Raise ValueError if the fault is impossible for these vehicles. The message names an alternative."""

    @property
    def further_vehicles(self) -> Sequence[int]:
        """The vehicle IDs that the further keys of the fault contain."""
        return ()

    @property
    def disk_after(self) -> DiskState | None:
        """The state of the disks after the fault. None if the fault does not concern disks."""
        return None

    @classmethod
    def loses_data(cls, disk: DiskState | None) -> bool:
        """True if the agents lose all their data because of this fault. `disk` is the state of their disks before the
        fault.
        """
        return cls.ends_incarnation and not cls.exports_chain and disk != "kept"

    @classmethod
    def further_keys(cls) -> list[str]:
        """Return the keys of the timeline entry, except `at_s` and the name of the fault."""
        return [field.name for field in fields(cls) if field.name not in Fault.__dataclass_fields__]

    @classmethod
    def entry_keys(cls, *agents: int, **further: Any) -> dict[str, object]:
        """Return the keys of a timeline entry, from the arguments of a call in a pytest test."""
        return {cls.what: list(agents), **cls.default_values, **further}

    @property
    def detail(self) -> str:
        agents = f"agent{'s' if len(self.agents) > 1 else ''} {' '.join(map(str, self.agents))}"
        return agents if self.disk_after is None else f"{agents}, disk {self.disk_after}"

    def to_json(self, at_s: float) -> dict[str, object]:
        """Return the record of this fault. `at_s` is the mission second at which the fault really happened."""
        record = {"at_s": at_s, "what": self.what, "detail": self.detail, "agents": list(self.agents)}
        hand = {"by_hand": True} if self.by_hand else {}
        disk = {} if self.disk_after is None else {"disk": self.disk_after}
        return {**record, **disk, **planned_key(self.at_s, at_s), **hand}


SAME_TIME_S = 0.001
"""Two times that differ by at most this number of seconds count as equal, because records round to milliseconds."""


def planned_key(planned_s: float, at_s: float) -> dict[str, float]:
    """Return the key `planned_s` for the record of a change that was made later than planned. For a change that was
    made in time, return no key.
    """
    return {} if abs(planned_s - at_s) < SAME_TIME_S else {"planned_s": planned_s}
