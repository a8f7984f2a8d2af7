"""Scenarios: what is asked of a run, as short YAML files validated by pydantic.

An error names the key, the value and what is allowed. `Scenario.model_json_schema()` documents every key.
"""

import dataclasses
import math
import reprlib
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from harness.errors import ScenarioError
from netem.conditions import LinkConditions, NetworkConditions
from netem.errors import ConditionsError
from ucp.block import MAX_AGENT_ID
from ucp.settings import Quirks, Settings

MAX_SCENARIO_BYTES = 1024 * 1024
MAX_AGENTS = 1000

BOUNDED = reprlib.Repr()  # a few lines of YAML aliases can stand for gigabytes
BOUNDED.maxlevel = 2

Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
VehicleId = Annotated[int, Field(ge=1, le=MAX_AGENT_ID, strict=True)]
VehicleKind = Literal["ardupilot", "embedded", "none"]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Receiver(_Model):
    """What one vehicle hears: loss of every message sent to it, independently per message."""

    loss: Probability


class NetworkModel(_Model):
    """Loss for every receiver, and receivers that differ."""

    loss: Probability = 0.0
    receivers: dict[VehicleId, Receiver] = {}

    def conditions(self, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
        return NetworkConditions(
            LinkConditions(loss=self.loss),
            {vehicle: LinkConditions(loss=receiver.loss) for vehicle, receiver in self.receivers.items()},
            partition,
        )


class TimelineEntry(_Model):
    """At `at_s` mission seconds, one change of the network: a new loss, a partition, or heal."""

    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    loss: Probability | None = None
    partition: list[list[VehicleId]] | None = None
    heal: Literal[True] | None = None

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        if sum(change is not None for change in (self.loss, self.partition, self.heal)) != 1:
            raise ValueError("needs exactly one of `loss`, `partition` or `heal: true`")
        return self


class Events(_Model):
    """Where an agent's loggable events come from.

    `mavlink`: the vehicle's telemetry, a position every `position_interval_s` mission seconds on average.
    `random`: Algorithm 21, one every `mean_s` mission seconds on average. Without vehicles events are random.
    """

    source: Literal["mavlink", "random"] = "mavlink"
    position_interval_s: Seconds = 10.0
    mean_s: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 30.0


class Vehicles(_Model):
    """The vehicles under the agents. `kind` unset: ArduPilot if a binary is found, else the embedded vehicle."""

    kind: VehicleKind | None = None
    binary: Path | None = None
    takeoff_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    home: tuple[float, float, float, float] = (-35.363262, 149.165237, 584.0, 353.0)
    """Latitude and longitude in degrees, altitude in metres, heading in degrees, of the first vehicle."""

    @field_validator("home")
    @classmethod
    def _on_earth(cls, home: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        latitude, longitude, _, _ = home
        if not all(math.isfinite(value) for value in home) or abs(latitude) > 90 or abs(longitude) > 180:
            raise ValueError("needs latitude -90..90, longitude -180..180, altitude (m) and heading (degrees)")
        return home


class Settle(_Model):
    """After the mission the agents finish their votes and reconciles, for at most `limit_s` mission seconds."""

    limit_s: Seconds = 1800.0


class Scenario(_Model):
    """One experiment. Times are mission seconds."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    agents: int | list[int] = 5
    duration_s: Seconds = 1200.0
    speedup: Annotated[float, Field(gt=0, le=1000)] = 20.0
    network: NetworkModel = NetworkModel()
    timeline: Annotated[list[TimelineEntry], Field(max_length=10_000)] = []
    events: Events = Events()
    vehicles: Vehicles = Vehicles()
    agent_command: Annotated[list[str], Field(min_length=1, max_length=100)] | None = None
    """Any program that follows ucp/CONTRACT.md, with its arguments; the mission file's name is added."""
    settings: Settings = Settings()
    quirks: Quirks = Quirks()
    settle: Settle = Settle()
    final_reconcile: bool = False

    @property
    def roster(self) -> tuple[int, ...]:
        """The agents' IDs, ascending."""
        return tuple(range(1, self.agents + 1)) if isinstance(self.agents, int) else tuple(sorted(self.agents))

    def timeline_in_order(self) -> list[TimelineEntry]:
        return sorted(self.timeline, key=lambda entry: entry.at_s)

    @field_validator("agents", mode="before")
    @classmethod
    def _count_or_ids(cls, agents: Any) -> Any:
        ids = range(1, agents + 1) if isinstance(agents, int) and agents <= MAX_AGENTS else agents
        if not isinstance(ids, range | list) or not 1 <= len(ids) <= MAX_AGENTS:
            raise ValueError(f"it should be a number of agents 1..{MAX_AGENTS}, or a list of their IDs")
        for agent in ids:
            if isinstance(agent, bool) or not isinstance(agent, int) or not 1 <= agent <= MAX_AGENT_ID:
                raise ValueError(f"{BOUNDED.repr(agent)} is not an agent ID: it should be 1..{MAX_AGENT_ID}")
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
            for name, value in quirks.items():
                Quirks().set(name, value)
        return quirks

    @model_validator(mode="after")
    def _consistent(self) -> "Scenario":
        roster = set(self.roster)
        for vehicle in self.network.receivers:
            if vehicle not in roster:
                raise ValueError(f"network.receivers names vehicle {vehicle}, which does not exist: {_names(roster)}")
        instants = Counter(entry.at_s for entry in self.timeline)
        for index, entry in enumerate(self.timeline):
            where = f"timeline.{index}"
            if entry.at_s > self.duration_s:
                raise ValueError(f"{where}.at_s {entry.at_s:g} is after the mission's end at {self.duration_s:g} s")
            if instants[entry.at_s] > 1:
                raise ValueError(f"{where}.at_s {entry.at_s:g} has two entries: which comes first?")
            try:
                partition = tuple(frozenset(group) for group in entry.partition or ())
                self.network.conditions(partition).validate(self.roster)
            except ConditionsError as error:
                raise ValueError(f"{where}: {error}") from None
        return self


def load_scenario(path: Path) -> Scenario:
    """Raises ScenarioError: one sentence that names the file, the key, the value and what is allowed."""
    try:
        if path.stat().st_size > MAX_SCENARIO_BYTES:
            raise ScenarioError(f"{path}: larger than {MAX_SCENARIO_BYTES} bytes, which no scenario is")
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it cannot be decoded"
        raise ScenarioError(f"{path}: not YAML{where}: {problem}") from None
    if not isinstance(document, dict):
        raise ScenarioError(f"{path}: a scenario is a YAML mapping with at least `name`")
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        raise ScenarioError(f"{path}: {explain(error, Scenario)}") from None


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem that pydantic found, as one sentence for a person."""
    problems: list[Any] = error.errors()
    problem = max(problems, key=lambda candidate: len(candidate["loc"]))
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"`{key}` is unknown: there are {', '.join(_siblings(model, problem['loc']))}"
    if problem["type"] == "missing":
        return f"`{key}` is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not key:
        return str(message)
    shown = BOUNDED.repr(problem["input"])
    return f"`{key}` is {shown}: it {message}" if message.startswith("should") else f"`{key}` is {shown}: {message}"


def _siblings(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """The keys that are allowed beside the one at `location`."""
    current: Any = model
    for part in location[:-1]:
        if isinstance(part, str) and part in current.model_fields:
            annotation = current.model_fields[part].annotation
            candidates = [annotation, *getattr(annotation, "__args__", ())]
            current = next((one for one in candidates if isinstance(one, type) and issubclass(one, BaseModel)), current)
    return list(current.model_fields)


def _names(roster: set[int]) -> str:
    ordered = sorted(roster)
    return f"there are {', '.join(map(str, ordered[:20]))}{', ...' if len(ordered) > 20 else ''}"
