"""One experiment, whole: `Scenario.model_json_schema()` documents every key."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from harness.scenario._network import NetworkModel
from harness.scenario.agent_options import (
    AgentCommand,
    AskedQuirks,
    Docker,
    Events,
    OfSome,
    Security,
    Stagger,
    of_agent,
    staggered,
)
from harness.scenario.agent_options import check as check_quirks
from harness.scenario.expect import Expect
from harness.scenario.fates import Fate
from harness.scenario.faults import Fault
from harness.scenario.faults.fault import KILLED, RUNNING
from harness.scenario.injection import ScriptedDatagram
from harness.scenario.network_states import Step, refuse_ambiguity, steps
from harness.scenario.strict_model import MAX_AGENTS, Data, Lateness, Model, Seconds, VehicleKey
from harness.scenario.timeline import NEEDED, Schedule, TimelineEntry
from harness.scenario.vehicles import Flight, Vehicles
from netem.conditions import NetworkConditions
from netem.errors import ConditionsError
from sitl.address import Address
from sitl.plan import PlanError
from sitl.vehicle import VehicleError
from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES
from ucp.events import EVENT_HEADER_BYTES
from ucp.quirks import Quirks, in_force
from ucp.sealed import SEAL_BYTES
from ucp.settings import Settings
from ucp.short_value import shown

MAX_DURATION_S = 31 * 86400
"""No mission is longer: a run in virtual time would take hours and all memory."""
MAX_INITIAL_DATA = 64 * 1024


class Settle(Model):
    """After the mission the agents finish their votes and reconciles, for at most `limit_s` mission seconds."""

    limit_s: Seconds = 1800.0


class Clock(Model):
    """An agent's own clock: at mission second t it shows offset_s + (1 + drift) * t seconds."""

    offset_s: Annotated[float, Field(ge=-1e10, le=1e10)] = 0.0
    drift: Annotated[float, Field(gt=-0.5, le=1.0)] = 0.0

    def shows(self, mission_s: float) -> float:
        """What it shows then."""
        return self.offset_s + (1 + self.drift) * mission_s

    def mission_s(self, shown_s: float) -> float:
        """When it shows that."""
        return (shown_s - self.offset_s) / (1 + self.drift)


class Scenario(Model):
    """One experiment. Times are mission seconds."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    """What the run shows, for its report."""
    agents: int | list[int] = 5
    """How many, or their IDs."""
    duration_s: Annotated[Seconds, Field(le=MAX_DURATION_S)] = 1200.0
    """For so long events are logged; then the agents finish what they are about."""
    speedup: Annotated[float, Field(gt=0, le=1000)] = 20.0
    """Mission seconds per second, of processes and containers."""
    network: NetworkModel = NetworkModel()
    """Conditions from the start on, until the timeline changes them."""
    timeline: Annotated[list[TimelineEntry], Field(max_length=10_000)] = []
    """What happens when, to the network and to agents."""
    schedule: Annotated[list[Schedule], Field(max_length=100)] = []
    """What happens to the network again and again."""
    events: Events = Events()
    """What the agents log."""
    vehicles: Vehicles = Vehicles()
    """What carries the agents."""
    flight: Annotated[list[Flight], Field(max_length=MAX_AGENTS)] = []
    """Where vehicles fly; those that no plan names take off and stay."""
    agent_command: AgentCommand = None
    """Any program that follows ucp/contract/CONTRACT.md, with its arguments: for all agents, or by agent for some."""
    docker: Docker = Docker()
    """What containers are made from, and may use."""
    settings: Settings = Settings()
    """The agents' timers, and how they read what the thesis leaves open."""
    stagger: Stagger = {}
    """By how many seconds timers of each agent run longer than those of the agent before it: it is told so."""
    security: Security | None = None
    """Keys for all agents; without, whatever is on the air counts."""
    quirks: AskedQuirks = {}
    """Mistakes that all agents make, or those that are named (`ucp.quirks`)."""
    clocks: dict[VehicleKey, Clock] = {}
    """What agents' own clocks show, by agent, in virtual time."""
    fates: Annotated[list[Fate], Field(max_length=100_000)] = []
    """What becomes of single messages, in virtual time."""
    datagrams: Annotated[list[ScriptedDatagram], Field(max_length=100_000)] = []
    """What is on the air beside what agents send."""
    lateness: dict[VehicleKey, Lateness] = {}
    """Timers that end late, by agent: "3+0.25" is the fourth that it has started, from 0 through all its lives, which
    ends a quarter of a mission second late. Those between are punctual."""
    initial_data: Annotated[Data, Field(max_length=MAX_INITIAL_DATA)] | None = None
    """BD_0, in base64. Without it each run has its own: in virtual time made of `name` and seed."""
    settle: Settle = Settle()
    """How long agents may finish after the mission."""
    final_reconcile: bool = False
    """At the end clear all conditions, and let one agent after another reconcile."""
    capture: bool = False
    """Keep every frame that a vehicle sent, and every one that reached it, in capture/<ID>.pcapng."""
    gcs: Annotated[str, Field(max_length=300)] | None = None
    """HOST:PORT of a ground station, by UDP, that sees all vehicles and may command them; usually 127.0.0.1:14550."""
    expect: Expect | None = None
    """For pytest, which collects the file as tests if it has this."""

    @field_validator("gcs")
    @classmethod
    def _is_an_address(cls, gcs: str | None) -> str | None:
        try:
            return gcs and str(Address.parse(gcs))
        except VehicleError as error:
            raise ValueError(str(error)) from None

    @property
    def roster(self) -> tuple[int, ...]:
        """The agents' IDs, ascending."""
        return tuple(range(1, self.agents + 1)) if isinstance(self.agents, int) else tuple(sorted(self.agents))

    def secured(self) -> "Scenario":
        """The same with keys; fresh ones if it has none."""
        return self if self.security else self.model_copy(update={"security": Security()})

    def settings_of(self, agent_id: int) -> Settings:
        """What the mission tells the agent."""
        told = staggered(self.settings, self.stagger, self.roster.index(agent_id))
        if self.security is not None and self.security.seal:
            largest = min(told.max_block_bytes, MAX_EVENT_DATA_BYTES - SEAL_BYTES)
            told = dataclasses.replace(
                told, max_block_bytes=largest, max_event_bytes=min(told.max_event_bytes, largest)
            )
        return told

    @property
    def rogue(self) -> int | None:
        """The rogue node's ID on the air, which no agent has; None if the timeline injects nothing."""
        if not any(entry.injection for entry in self.timeline):
            return None
        taken = set(self.roster)
        return next(vehicle for vehicle in range(MAX_AGENT_ID, 0, -1) if vehicle not in taken)

    @property
    def on_the_air(self) -> tuple[int, ...]:
        """The vehicles, and the rogue node if there is one."""
        return self.roster if self.rogue is None else (*self.roster, self.rogue)

    def command_of(self, agent_id: int) -> list[str] | None:
        """What starts this agent, but for the mission file; None of one that is the harness's own."""
        asked = self.agent_command
        return asked.get(agent_id) if isinstance(asked, dict) else asked

    @property
    def foreign(self) -> tuple[int, ...]:
        """The agents that are not the harness's own, as the scenario says itself; ascending."""
        return tuple(agent_id for agent_id in self.roster if self.command_of(agent_id) is not None)

    def quirks_of(self, agent_id: int) -> Quirks:
        """Mistakes that this agent is asked to make."""
        return of_agent(self.quirks, agent_id)

    @property
    def has_wrong_agents(self) -> bool:
        """Whether any agent is wrong on purpose."""
        return any(in_force(self.quirks_of(agent_id)) for agent_id in self.roster)

    def flight_of(self, vehicle: int) -> Flight | None:
        """The flight that names this vehicle, if one does."""
        return next((flight for flight in self.flight if vehicle in flight.vehicles), None)

    def timeline_in_order(self) -> list[TimelineEntry]:
        return sorted(self.timeline, key=lambda entry: entry.at_s)

    def faults_in_order(self) -> list[Fault]:
        """All that happens to agents; of one instant what was begun first."""
        return [fault for _, fault in self._faults_with_their_keys()]

    def _faults_with_their_keys(self) -> list[tuple[str, Fault]]:
        begun = [(f"timeline.{index}", entry.fault) for index, entry in enumerate(self.timeline) if entry.fault]
        begun.sort(key=lambda keyed: keyed[1].at_s)
        course = [(f"{where}.{fault.what}", stage) for where, fault in begun for stage in fault.course()]
        return sorted(course, key=lambda keyed: keyed[1].at_s)

    def network_steps(self) -> Iterator[Step]:
        """Every change of the network, by the timeline and by schedules."""
        return steps(self.network, self.roster, self.timeline, self.schedule, self.duration_s)

    @field_validator("agents", mode="before")
    @classmethod
    def _count_or_ids(cls, agents: Any) -> Any:
        ids = range(1, agents + 1) if isinstance(agents, int) and agents <= MAX_AGENTS else agents
        if not isinstance(ids, range | list) or not 1 <= len(ids) <= MAX_AGENTS:
            raise ValueError(f"it should be a number of agents 1..{MAX_AGENTS}, or a list of their IDs")
        for agent in ids:
            if isinstance(agent, bool) or not isinstance(agent, int) or not 1 <= agent <= MAX_AGENT_ID:
                raise ValueError(f"{shown(agent)} is not an agent ID: it should be 1..{MAX_AGENT_ID}")
        if len(set(ids)) < len(ids):
            raise ValueError(f"names {Counter(ids).most_common(1)[0][0]} twice")
        return agents

    @field_validator("settings", mode="before")
    @classmethod
    def _known_settings(cls, settings: Any) -> Any:
        known = [field.name for field in dataclasses.fields(Settings)]
        for name in settings if isinstance(settings, dict) else ():
            if name not in known:
                raise ValueError(f"{name} is unknown: there are {', '.join(known)}")
        return settings

    @field_validator("quirks", mode="before")
    @classmethod
    def _known_quirks(cls, quirks: Any) -> Any:
        if isinstance(quirks, dict):
            check_quirks(quirks)
        return quirks

    @model_validator(mode="after")
    def _names_what_there_is(self) -> "Scenario":
        roster = set(self.roster)
        for key, vehicle in self._named():
            if vehicle not in roster:
                raise ValueError(f"{key} names vehicle {vehicle}, which does not exist: {_names(roster)}")
        names = Counter(fate.name for fate in self.fates if fate.name is not None)
        for index, fate in enumerate(self.fates):
            if fate.name is not None and names[fate.name] > 1:
                raise ValueError(f"fates.{index}.name {fate.name!r} is taken by another fate")
            if fate.after is not None and fate.after not in names:
                raise ValueError(f"fates.{index}.after {fate.after!r} is the name of no fate")
        return self

    def _named(self) -> Iterator[tuple[str, int]]:
        """Every vehicle that is named anywhere but in a partition, with the key that names it."""
        yield from ((f"network.{key}", vehicle) for key, vehicle in self.network.named())
        yield from ((f"events.script.{index}.agent", event.agent) for index, event in enumerate(self.events.script))
        yield from (("clocks", vehicle) for vehicle in self.clocks)
        yield from (("lateness", vehicle) for vehicle in self.lateness)
        if isinstance(self.agent_command, dict):
            yield from (("agent_command", agent) for agent in self.agent_command)
        for index, datagram in enumerate(self.datagrams):
            yield from ((f"datagrams.{index}.reaches", vehicle) for vehicle in datagram.reaches)
        for name, asked in self.quirks.items():
            yield from (
                (f"quirks.{name}.agents", agent) for agent in (asked.agents if isinstance(asked, OfSome) else ())
            )
        yield from (("vehicles.types", vehicle) for vehicle in self.vehicles.types)
        yield from (("vehicles.each", vehicle) for vehicle in self.vehicles.each)
        yield from ((f"expect.{key}", agent) for key, agent in (self.expect.named() if self.expect else ()))
        for index, flight in enumerate(self.flight):
            yield from ((f"flight.{index}.vehicles", vehicle) for vehicle in flight.vehicles)
        for index, fate in enumerate(self.fates):
            yield from ((f"fates.{index}.sender", vehicle) for vehicle in (fate.sender,) if vehicle)
            yield from ((f"fates.{index}.receiver", vehicle) for vehicle in (fate.receiver,) if vehicle)
            yield from ((f"fates.{index}.block", int(name.split(".")[0])) for name in (fate.block,) if name)
        for index, schedule in enumerate(self.schedule):
            yield from ((f"schedule.{index}.{key}", vehicle) for key, vehicle in schedule.named())
        for index, entry in enumerate(self.timeline):
            if entry.fault is not None:
                named = (*entry.fault.agents, *entry.fault.also_named)
                yield from ((f"timeline.{index}.{entry.fault.what}", agent) for agent in named)
            if entry.network is not None:
                yield from ((f"timeline.{index}.network.{key}", vehicle) for key, vehicle in entry.network.named())
            if entry.injection is not None:
                name, injection = entry.injection
                yield from ((f"timeline.{index}.{name}.sender", agent) for agent in (injection.sender,) if agent)
            if entry.lie is not None:
                yield from ((f"timeline.{index}.lie.receivers", agent) for agent in entry.lie.receivers or ())

    @model_validator(mode="after")
    def _plans_can_be_flown(self) -> "Scenario":
        for key, asked in (("flight", self.flight), ("network.radio", self.network.radio)):
            if asked and self.vehicles.kind == "none":
                raise ValueError(f"`{key}` needs vehicles, and `vehicles.kind` is none: leave one of them out")
        self.vehicles.check_frames(self.roster)
        for index, vehicle in enumerate(self.roster):
            try:
                self.vehicles.home_of(vehicle, index)
            except VehicleError as error:
                raise ValueError(f"the home of vehicle {vehicle}: {error}") from None
        types = {self.vehicles.type_of(vehicle) for vehicle in self.roster}
        if self.vehicles.binary is not None and len(types) > 1:
            raise ValueError(
                f"`vehicles.binary` is one program, and there are {' and '.join(sorted(types))}: "
                f"name the directory of their binaries in ARDUPILOT_SITL instead"
            )
        twice = Counter(vehicle for flight in self.flight for vehicle in flight.vehicles).most_common(1)
        if twice and twice[0][1] > 1:
            raise ValueError(f"`flight` names vehicle {twice[0][0]} twice: a vehicle flies one plan")
        for index, flight in enumerate(self.flight):
            for vehicle in flight.vehicles:
                try:
                    flight.planned().check(self.vehicles.type_of(vehicle))
                except PlanError as error:
                    raise ValueError(f"flight.{index}.plan, for vehicle {vehicle}: {error}") from None
        return self

    @model_validator(mode="after")
    def _timers_can_be_staggered(self) -> "Scenario":
        try:
            staggered(self.settings, self.stagger, len(self.roster) - 1)
        except ValueError as error:
            raise ValueError(f"by `stagger` the last agent's {error}") from None
        return self

    @model_validator(mode="after")
    def _events_fit(self) -> "Scenario":
        largest = self.settings.max_event_bytes - EVENT_HEADER_BYTES
        for index, event in enumerate(self.events.script):
            if (size := len(event.event_data)) > largest:
                why = f"by `settings.max_event_bytes` an event has at most {largest} bytes of data, not {size}"
                raise ValueError(f"events.script.{index}: {why}")
            if event.sealed is not None and self.settings.max_block_bytes > MAX_EVENT_DATA_BYTES - SEAL_BYTES:
                why = f"takes `settings.max_block_bytes` of at most {MAX_EVENT_DATA_BYTES - SEAL_BYTES}"
                raise ValueError(f"events.script.{index}.sealed {why}")
        return self

    @model_validator(mode="after")
    def _schedule_can_be_played(self) -> "Scenario":
        for index, schedule in enumerate(self.schedule):
            where = f"schedule.{index}"
            for key in ("from_s", "until_s"):
                at_s = getattr(schedule, key)
                if at_s is not None and at_s > self.duration_s:
                    raise ValueError(f"{where}.{key} {at_s:g} is after the mission's end at {self.duration_s:g} s")
            if schedule.nemesis is not None and len(self.roster) < NEEDED[schedule.nemesis]:
                raise ValueError(f"{where}.nemesis {schedule.nemesis!r} needs {NEEDED[schedule.nemesis]} vehicles")
            try:
                if schedule.repeat is not None:
                    NetworkConditions(partition=schedule.repeat.groups).validate(self.roster)
                schedule.steps(self.roster, self.duration_s)
            except (ConditionsError, ValueError) as error:
                raise ValueError(f"{where}: {error}") from None
        return self

    @model_validator(mode="after")
    def _somebody_is_captured(self) -> "Scenario":
        captured = self.security.captured if self.security else None
        if captured is not None and captured not in self.roster:
            raise ValueError(f"security.captured {captured} is not one of the agents {sorted(self.roster)}")
        return self

    @model_validator(mode="after")
    def _timeline_can_be_played(self) -> "Scenario":
        instants = Counter(entry.at_s for entry in self.timeline)
        for index, entry in enumerate(self.timeline):
            where = f"timeline.{index}"
            if entry.at_s > self.duration_s:
                raise ValueError(f"{where}.at_s {entry.at_s:g} is after the mission's end at {self.duration_s:g} s")
            if entry.fault is None and entry.ends_at_s > self.duration_s:
                key = entry.injection[0] if entry.injection else entry.disturbs
                end = f"the mission's end at {self.duration_s:g} s"
                raise ValueError(f"{where}.{key} would last until {entry.ends_at_s:g} s, after {end}")
            if instants[entry.at_s] > 1:
                raise ValueError(f"{where}.at_s {entry.at_s:g} has two entries: which comes first?")
            try:
                NetworkConditions(partition=entry.groups).validate(self.roster)
            except ConditionsError as error:
                raise ValueError(f"{where}: {error}") from None
        refuse_ambiguity(self.timeline)
        return self

    @model_validator(mode="after")
    def _network_means_something_all_along(self) -> "Scenario":
        for step in self.network_steps():
            try:
                step.network.uncut()
            except ConditionsError as error:
                raise ValueError(f"{', '.join(step.keys)}, at {step.at_s:g} s: {error}") from None
        return self

    @model_validator(mode="after")
    def _faults_can_be_played(self) -> "Scenario":
        state = dict.fromkeys(self.roster, RUNNING)
        for where, fault in self._faults_with_their_keys():
            if fault.at_s > self.duration_s:
                end = f"the mission's end at {self.duration_s:g} s"
                raise ValueError(f"{where}: its agents would be back at {fault.at_s:g} s, after {end}")
            try:
                fault.check(self.vehicles)
            except ValueError as error:
                raise ValueError(f"{where} {error}") from None
            if fault.needs_keys and self.security is None:
                raise ValueError(f"{where} is about keys, which a mission has with `security: {{keys: fresh}}`")
            for agent in fault.agents:
                if state[agent] not in fault.needs:
                    raise ValueError(f"{where}: agent {agent} is {state[agent]} then, not {' or '.join(fault.needs)}")
                state[agent] = fault.leads_to or state[agent]
        if set(state.values()) == {KILLED}:
            raise ValueError("the timeline leaves nobody: at the end all agents are killed; spare or restart one")
        return self


def _names(roster: set[int]) -> str:
    ordered = sorted(roster)
    return f"there are {', '.join(map(str, ordered[:20]))}{', ...' if len(ordered) > 20 else ''}"
