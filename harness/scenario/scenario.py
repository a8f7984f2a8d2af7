"""The model of a scenario. `Scenario.model_json_schema()` returns the description of every key."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import FailFast, Field, field_validator, model_validator

from harness.present.text import did_you_mean
from harness.scenario._network import NetworkModel
from harness.scenario.agent_options import (
    AgentCommand,
    DockerOptions,
    EventOptions,
    QuirkOfAgents,
    QuirkValues,
    RemoteOptions,
    SecurityOptions,
    Stagger,
    check_quirks,
    quirks_of_agent,
    staggered,
)
from harness.scenario.expect import Expect
from harness.scenario.fates import Fate
from harness.scenario.faults import Fault
from harness.scenario.faults.fault import KILLED, RUNNING
from harness.scenario.injection import ScriptedDatagram
from harness.scenario.network_states import NetworkStep, network_steps, refuse_ambiguous_overlaps
from harness.scenario.strict_model import MAX_AGENTS, Data, Lateness, Seconds, StrictModel, VehicleKey
from harness.scenario.timeline import MIN_VEHICLES, Schedule, TimelineEntry
from harness.scenario.vehicles import Flight, Vehicles
from netem.conditions import NetworkConditions
from netem.errors import ConditionsError
from sitl.address import ListenAddress
from sitl.plan import PlanError
from sitl.vehicle import VehicleError
from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES
from ucp.events import EVENT_HEADER_BYTES
from ucp.quirks import Quirks, active_quirks
from ucp.sealed import SEAL_BYTES
from ucp.settings import Settings
from ucp.short_value import shown

MAX_DURATION_S = 31 * 86400
"""Maximum duration of a mission in seconds. A longer run in virtual time would take hours and fill the memory."""
MAX_INITIAL_DATA = 64 * 1024


class SettlePhase(StrictModel):
    """The time after the mission in which agents finish their votes and reconciles."""

    limit_s: Seconds = 1800.0
    """Maximum number of mission seconds. The run ends as soon as all agents are idle."""


class AgentClock(StrictModel):
    """The clock of one agent. At mission second t it shows `offset_s` + (1 + `drift`) * t seconds."""

    offset_s: Annotated[float, Field(ge=-1e10, le=1e10)] = 0.0
    """Seconds that the clock shows at the start of the mission."""
    drift: Annotated[float, Field(gt=-0.5, le=1.0)] = 0.0
    """Relative error of the rate. A clock with a drift of 0.01 gains one second in 100 mission seconds."""

    def shows(self, mission_s: float) -> float:
        """Return the time in seconds that the clock shows at this mission second."""
        return self.offset_s + (1 + self.drift) * mission_s

    def mission_s(self, shown_s: float) -> float:
        """Return the mission second at which the clock shows this time."""
        return (shown_s - self.offset_s) / (1 + self.drift)


class Scenario(StrictModel):
    """One experiment. All times are mission seconds, counted from the start of the mission."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    """Name of the scenario, of 1 to 200 characters. Run directories and reports contain it."""
    about: Annotated[str, Field(max_length=2000)] = ""
    """Purpose of the run, of at most 2000 characters. The report shows it."""
    agents: int | list[int] = 5
    """Number of agents, 1 to 1000, or a list of their IDs. The number `n` stands for the IDs 1 to `n`."""
    duration_s: Annotated[Seconds, Field(le=MAX_DURATION_S)] = 1200.0
    """Duration of the mission in mission seconds. Agents log events until the end of the mission. Then the time of
    `settle` begins.
    """
    speedup: Annotated[float, Field(gt=0, le=1000)] = 20.0
    """Mission seconds per second of wall time, for processes and containers. Virtual time ignores it."""
    network: NetworkModel = NetworkModel()
    """Network conditions at the start. `timeline` and `schedule` can change them."""
    timeline: Annotated[list[TimelineEntry], Field(max_length=10_000)] = []
    """Changes of the network, faults of agents, and injected messages, each at one mission second."""
    schedule: Annotated[list[Schedule], Field(max_length=100)] = []
    """Ramps and repeated changes of the network."""
    events: EventOptions = EventOptions()
    """Source of the events that agents log."""
    vehicles: Vehicles = Vehicles()
    """Vehicles that carry the agents: ArduPilot, embedded vehicles, or none."""
    flight: Annotated[list[Flight], Field(max_length=MAX_AGENTS)] = []
    """Flight plans. A vehicle without a plan takes off and stays in place."""
    agent_command: AgentCommand = None
    """A program that follows ucp/contract/CONTRACT.md, with its arguments. A list is the command of all agents. A
    mapping has a command for each listed agent ID. All other agents are the harness's own.
    """
    remote: RemoteOptions | None = None
    """Agents that run on other computers. Only the backend `process` plays them."""
    docker: DockerOptions = DockerOptions()
    """Image and resource limits of containers. Only the backend `docker` uses them."""
    settings: Settings = Settings()
    """Timers and sizes of the agents, and their interpretations of ambiguous passages in the thesis."""
    stagger: Stagger = {}
    """Timer -> mission seconds by which this timer is longer than the same timer of the agent with the next lower ID.
    The mission file of each agent contains the agent's own durations.
    """
    security: SecurityOptions | None = None
    """Keys of a secured mission. Without this key, the mission is not secured, and agents accept every datagram."""
    quirks: QuirkValues = {}
    """Deliberate mistakes (quirks) of all agents, or of the listed agents. `ucp.quirks` declares them."""
    clocks: dict[VehicleKey, AgentClock] = {}
    """Clocks of agents, by agent ID. Other agents have an exact clock. In virtual time only."""
    fates: Annotated[list[Fate], Field(max_length=100_000), FailFast()] = []
    """Scripted delivery or loss of single messages. In virtual time only."""
    datagrams: Annotated[list[ScriptedDatagram], Field(max_length=100_000), FailFast()] = []
    """Datagrams that no agent sent but that agents receive. In virtual time only."""
    lateness: dict[VehicleKey, Lateness] = {}
    """Late timers, by agent ID. In "3+0.25 8+1" the timer with number 3 expires 0.25 mission seconds late, and number 8
    one second late. The timers that the agent starts are numbered from 0, across its reboots. Other timers are
    punctual.
    """
    initial_data: Annotated[Data, Field(max_length=MAX_INITIAL_DATA)] | None = None
    """Data of the inception block (BD_0), in base64, at most 65536 characters. By default each run has its own data. In
    virtual time they are computed from `name` and the seed.
    """
    settle: SettlePhase = SettlePhase()
    """Time after the mission in which agents may finish."""
    final_reconcile: bool = False
    """True if the run ends with a final reconcile: under perfect network conditions, one agent after another
    reconciles.
    """
    capture: bool = False
    """True if the run writes all frames that a vehicle sent or received to capture/<ID>.pcapng."""
    trace_quota_mb: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """Maximum size of all traces together, in megabytes. Each agent may use an equal share, but at least 8 megabytes.
    If the trace of an agent reaches its share, the trace ends early. By default, the maximum is half of the free disk
    space.
    """
    gcs: Annotated[str, Field(max_length=300)] | None = None
    """HOST:PORT of a ground station, usually 127.0.0.1:14550. The ground station receives the telemetry of all vehicles
    by UDP, and may command the vehicles.
    """
    expect: Expect | None = None
    """Expected results. pytest collects a scenario file with this key as tests."""

    @field_validator("gcs")
    @classmethod
    def _is_an_address(cls, gcs: str | None) -> str | None:
        try:
            return gcs and str(ListenAddress.parse(gcs))
        except VehicleError as error:
            raise ValueError(str(error)) from None

    @property
    def roster(self) -> tuple[int, ...]:
        """The IDs of the agents in ascending order."""
        return tuple(range(1, self.agents + 1)) if isinstance(self.agents, int) else tuple(sorted(self.agents))

    def secured(self) -> "Scenario":
        """Return a copy of the scenario with new keys. If it already has keys, return it unchanged."""
        return self if self.security else self.model_copy(update={"security": SecurityOptions()})

    def settings_of(self, agent_id: int) -> Settings:
        """Return the settings in the mission file of this agent."""
        settings = staggered(self.settings, self.stagger, self.roster.index(agent_id))
        if self.security is not None and self.security.seal:
            largest = min(settings.max_block_bytes, MAX_EVENT_DATA_BYTES - SEAL_BYTES)
            settings = dataclasses.replace(
                settings, max_block_bytes=largest, max_event_bytes=min(settings.max_event_bytes, largest)
            )
        return settings

    @property
    def rogue(self) -> int | None:
        """The ID of the rogue node in the network, which no agent has. None if the timeline injects no messages."""
        if not any(entry.injection for entry in self.timeline):
            return None
        taken = set(self.roster)
        return next(vehicle for vehicle in range(MAX_AGENT_ID, 0, -1) if vehicle not in taken)

    @property
    def network_nodes(self) -> tuple[int, ...]:
        """The vehicles, and the rogue node if there is one."""
        return self.roster if self.rogue is None else (*self.roster, self.rogue)

    def command_of(self, agent_id: int) -> list[str] | None:
        """Return the command of this agent without the mission file. Return None for the harness's own agent."""
        asked = self.agent_command
        return asked.get(agent_id) if isinstance(asked, dict) else asked

    @property
    def foreign(self) -> tuple[int, ...]:
        """The IDs of foreign agents, which have a command in `agent_command`, in ascending order."""
        return tuple(agent_id for agent_id in self.roster if self.command_of(agent_id) is not None)

    def quirks_of(self, agent_id: int) -> Quirks:
        """Return the deliberate errors (quirks) of this agent."""
        return quirks_of_agent(self.quirks, agent_id)

    @property
    def has_wrong_agents(self) -> bool:
        """True if any agent makes deliberate errors."""
        return any(active_quirks(self.quirks_of(agent_id)) for agent_id in self.roster)

    def flight_of(self, vehicle: int) -> Flight | None:
        """Return the flight plan of this vehicle. Return None if the vehicle has none."""
        return next((flight for flight in self.flight if vehicle in flight.vehicles), None)

    def timeline_in_order(self) -> list[TimelineEntry]:
        return sorted(self.timeline, key=lambda entry: entry.at_s)

    def faults_in_order(self) -> list[Fault]:
        """Return all faults in order of time. Faults at the same time keep the order of their timeline entries."""
        return [fault for _, fault in self._faults_with_their_keys()]

    def with_disk(self) -> set[int]:
        """Return the agents that a fault of the timeline restarts with the data on their disks."""
        return {agent for fault in self.faults_in_order() if fault.disk_after == "kept" for agent in fault.agents}

    def _faults_with_their_keys(self) -> list[tuple[str, Fault]]:
        begun = [(f"timeline.{index}", entry.fault) for index, entry in enumerate(self.timeline) if entry.fault]
        begun.sort(key=lambda keyed: keyed[1].at_s)
        course = [(f"{where}.{fault.what}", stage) for where, fault in begun for stage in fault.stages()]
        return sorted(course, key=lambda keyed: keyed[1].at_s)

    def network_steps(self) -> Iterator[NetworkStep]:
        """Yield every change of the network by the timeline and the schedules, in order of time."""
        return network_steps(self.network, self.roster, self.timeline, self.schedule, self.duration_s)

    @field_validator("agents", mode="before")
    @classmethod
    def _count_or_ids(cls, agents: Any) -> Any:
        ids = range(1, agents + 1) if isinstance(agents, int) and agents <= MAX_AGENTS else agents
        if not isinstance(ids, range | list) or not 1 <= len(ids) <= MAX_AGENTS:
            raise ValueError(f"use a number of agents 1..{MAX_AGENTS}, or a list of their IDs")
        for agent in ids:
            if isinstance(agent, bool) or not isinstance(agent, int) or not 1 <= agent <= MAX_AGENT_ID:
                raise ValueError(f"{shown(agent)} is not an agent ID: use 1..{MAX_AGENT_ID}")
        if len(set(ids)) < len(ids):
            raise ValueError(f"names {Counter(ids).most_common(1)[0][0]} twice")
        return agents

    @field_validator("settings", mode="before")
    @classmethod
    def _known_settings(cls, settings: Any) -> Any:
        known = [field.name for field in dataclasses.fields(Settings)]
        for name in settings if isinstance(settings, dict) else ():
            if name not in known:
                raise ValueError(f"{name} is unknown: use one of {', '.join(known)}{did_you_mean(name, known)}")
        return settings

    @field_validator("quirks", mode="before")
    @classmethod
    def _known_quirks(cls, quirks: Any) -> Any:
        if isinstance(quirks, dict):
            check_quirks(quirks)
        return quirks

    @model_validator(mode="after")
    def _named_vehicles_exist(self) -> "Scenario":
        roster = set(self.roster)
        for key, vehicle in self._named_vehicles():
            if vehicle not in roster:
                raise ValueError(f"{key} names vehicle {vehicle}, which is not on the roster: {_names(roster)}")
        names = Counter(fate.name for fate in self.fates if fate.name is not None)
        for index, fate in enumerate(self.fates):
            if fate.name is not None and names[fate.name] > 1:
                raise ValueError(f"fates.{index}.name {fate.name!r} is the name of another fate")
            if fate.after is not None and fate.after not in names:
                raise ValueError(f"fates.{index}.after {fate.after!r} is not the name of a fate")
        return self

    def _named_vehicles(self) -> Iterator[tuple[str, int]]:
        """Yield each vehicle ID in the scenario, with the key that contains it. IDs in partitions are not included."""
        yield from ((f"network.{key}", vehicle) for key, vehicle in self.network.named_vehicles())
        yield from ((f"events.script.{index}.agent", event.agent) for index, event in enumerate(self.events.script))
        yield from (("clocks", vehicle) for vehicle in self.clocks)
        yield from (("lateness", vehicle) for vehicle in self.lateness)
        if isinstance(self.agent_command, dict):
            yield from (("agent_command", agent) for agent in self.agent_command)
        if self.remote is not None:
            yield from (("remote.agents", agent) for agent in self.remote.agents)
        for index, datagram in enumerate(self.datagrams):
            yield from ((f"datagrams.{index}.reaches", vehicle) for vehicle in datagram.reaches)
        for name, asked in self.quirks.items():
            yield from (
                (f"quirks.{name}.agents", agent) for agent in (asked.agents if isinstance(asked, QuirkOfAgents) else ())
            )
        yield from (("vehicles.types", vehicle) for vehicle in self.vehicles.types)
        yield from (("vehicles.each", vehicle) for vehicle in self.vehicles.each)
        yield from ((f"expect.{key}", agent) for key, agent in (self.expect.named_agents() if self.expect else ()))
        for index, flight in enumerate(self.flight):
            yield from ((f"flight.{index}.vehicles", vehicle) for vehicle in flight.vehicles)
        for index, fate in enumerate(self.fates):
            yield from ((f"fates.{index}.sender", vehicle) for vehicle in (fate.sender,) if vehicle)
            yield from ((f"fates.{index}.receiver", vehicle) for vehicle in (fate.receiver,) if vehicle)
            yield from ((f"fates.{index}.block", int(name.split(".")[0])) for name in (fate.block,) if name)
        for index, schedule in enumerate(self.schedule):
            yield from ((f"schedule.{index}.{key}", vehicle) for key, vehicle in schedule.named_vehicles())
        for index, entry in enumerate(self.timeline):
            if entry.fault is not None:
                named = (*entry.fault.agents, *entry.fault.further_vehicles)
                yield from ((f"timeline.{index}.{entry.fault.what}", agent) for agent in named)
            if entry.network is not None:
                yield from (
                    (f"timeline.{index}.network.{key}", vehicle) for key, vehicle in entry.network.named_vehicles()
                )
            if entry.injection is not None:
                name, injection = entry.injection
                yield from ((f"timeline.{index}.{name}.sender", agent) for agent in (injection.sender,) if agent)
            if entry.lie is not None:
                yield from ((f"timeline.{index}.lie.receivers", agent) for agent in entry.lie.receivers or ())

    @model_validator(mode="after")
    def _plans_can_be_flown(self) -> "Scenario":
        network = self.network
        positions = {"flight": self.flight, "network.radio": network.radio, "network.channel": network.channel}
        for key, asked in positions.items():
            if asked and self.vehicles.kind == "none":
                raise ValueError(f"`{key}` needs vehicles, but `vehicles.kind` is none: leave out one of them")
        self.vehicles.check_frames(self.roster)
        for index, vehicle in enumerate(self.roster):
            try:
                self.vehicles.home_of(vehicle, index)
            except VehicleError as error:
                raise ValueError(f"the home of vehicle {vehicle}: {error}") from None
        types = {self.vehicles.type_of(vehicle) for vehicle in self.roster}
        if self.vehicles.binary is not None and len(types) > 1:
            raise ValueError(
                f"`vehicles.binary` is one program, but the vehicles are of types {' and '.join(sorted(types))}: set "
                "ARDUPILOT_SITL to the directory of their binaries"
            )
        twice = Counter(vehicle for flight in self.flight for vehicle in flight.vehicles).most_common(1)
        if twice and twice[0][1] > 1:
            raise ValueError(f"`flight` names vehicle {twice[0][0]} twice: a vehicle has one plan")
        for index, flight in enumerate(self.flight):
            for vehicle in flight.vehicles:
                try:
                    flight.to_plan().check(self.vehicles.type_of(vehicle))
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
            if schedule.nemesis is not None and len(self.roster) < MIN_VEHICLES[schedule.nemesis]:
                raise ValueError(
                    f"{where}.nemesis {schedule.nemesis!r} needs {MIN_VEHICLES[schedule.nemesis]} vehicles"
                )
            try:
                if schedule.repeat is not None:
                    NetworkConditions(partition=schedule.repeat.groups).validate(self.roster)
                schedule.steps(self.roster, self.duration_s)
            except (ConditionsError, ValueError) as error:
                raise ValueError(f"{where}: {error}") from None
        return self

    @model_validator(mode="after")
    def _remote_agents_can_be_played(self) -> "Scenario":
        if self.remote is None:
            return self
        for agent in self.remote.agents:
            if self.command_of(agent) is not None:
                raise ValueError(
                    f"agent {agent} is in `remote.agents`, so its command is that of its own computer: leave it out of "
                    "`agent_command`"
                )
        if self.vehicles.kind != "none" and self.events.source == "mavlink":
            raise ValueError(
                "an agent in `remote.agents` cannot read the telemetry of its vehicle: add `events: {source: random}`"
            )
        return self

    @model_validator(mode="after")
    def _captured_agent_exists(self) -> "Scenario":
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
                key = entry.injection[0] if entry.injection else entry.network_key
                end = f"the mission's end at {self.duration_s:g} s"
                raise ValueError(f"{where}.{key} would last until {entry.ends_at_s:g} s, after {end}")
            if instants[entry.at_s] > 1:
                raise ValueError(f"{where}.at_s {entry.at_s:g} has two entries: give each entry its own time")
            try:
                NetworkConditions(partition=entry.groups).validate(self.roster)
            except ConditionsError as error:
                raise ValueError(f"{where}: {error}") from None
        refuse_ambiguous_overlaps(self.timeline)
        return self

    @model_validator(mode="after")
    def _network_is_valid_throughout(self) -> "Scenario":
        for step in self.network_steps():
            where = f"{', '.join(step.keys) or 'network'}, at {step.at_s:g} s"
            try:
                conditions = step.network.without_partition()
            except ConditionsError as error:
                raise ValueError(f"{where}: {error}") from None
            for need in conditions.needs() if self.network.channel else ():
                if need.split()[-1] in ("rate", "limit"):
                    raise ValueError(f"{where}: `{need}` and `network.channel` both queue messages: leave out one")
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
                raise ValueError(f"{where} needs a mission with keys: add `security: {{keys: fresh}}`")
            for agent in fault.agents:
                if state[agent] not in fault.states_before:
                    raise ValueError(
                        f"{where}: agent {agent} is {state[agent]} at that time, not {' or '.join(fault.states_before)}"
                    )
                state[agent] = fault.state_after or state[agent]
        if set(state.values()) == {KILLED}:
            raise ValueError("the timeline kills all agents: keep or restart at least one")
        return self


def _names(roster: set[int]) -> str:
    ordered = sorted(roster)
    return f"use one of {', '.join(map(str, ordered[:20]))}{', ...' if len(ordered) > 20 else ''}"
