"""The agents of a scenario: commands, containers, events, keys, staggered timers and mistakes.

    agent_command: [./my_agent, --fast]
    agent_command: {2: [./my_agent, --fast], 5: [./another_agent]}
    quirks: {ignore_commit: 0.2, crash_on_tie: {agents: [32, 122]}}

Each agent receives its own settings in its mission file. It does not know that other agents have other settings.
"""

import base64
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from harness.scenario.strict_model import Data, Instant, Model, Seconds, VehicleId, VehicleKey
from ucp.block import MAX_AGENT_ID
from ucp.events import MAX_MEAN_S, LoggableEvent
from ucp.quirks import QUIRKS, Quirks, check_quirk
from ucp.settings import MAX_TIMER_S, Settings
from ucp.short_value import shown
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, EventKind

MAX_WORDS = 100

Command = Annotated[list[str], Field(min_length=1, max_length=MAX_WORDS)]
"""A program that follows ucp/contract/CONTRACT.md, and its arguments; the mission file's name is added."""


def _commands(asked: Any) -> Any:
    """Raises ValueError for what is neither: of a union pydantic would tell what is wrong by either reading."""
    if isinstance(asked, Mapping):
        for agent, words in asked.items():
            if not _is_agent(agent):
                raise ValueError(f"{shown(agent)} is not an agent ID: it should be 1..{MAX_AGENT_ID}")
            if not _is_command(words):
                raise ValueError(f"agent {shown(agent)} needs a program and its arguments, as a list")
    elif asked is not None and not _is_command(asked):
        raise ValueError("should be a program and its arguments, as a list, or a mapping of agent IDs to such lists")
    return asked


def _is_agent(key: object) -> bool:
    digits = shown(key).strip("'")
    return digits.isdecimal() and len(digits) <= len(str(MAX_AGENT_ID)) and 1 <= int(digits) <= MAX_AGENT_ID


def _is_command(words: Any) -> bool:
    return (
        isinstance(words, list)
        and 1 <= len(words) <= MAX_WORDS
        and all(isinstance(word, str) and "\0" not in word for word in words)
    )


AgentCommand = Annotated[Command | dict[VehicleKey, Command] | None, BeforeValidator(_commands)]


class OfSome(Model):
    """A mistake of these agents only; `value` is true, or the probability of a quirk that has one."""

    agents: Annotated[list[VehicleId], Field(min_length=1)]
    value: bool | float = True


def _schema() -> dict[str, Any]:
    known = {}
    for name, quirk in QUIRKS.items():
        kind, bounds = ("number", {"minimum": 0, "maximum": 1}) if quirk.chance else ("boolean", {})
        known[name] = {
            "description": quirk.sentence,
            "type": [kind, "object"],
            **bounds,
            "properties": {"agents": {"type": "array", "minItems": 1}, "value": {"type": kind, **bounds}},
            "required": ["agents", "value"] if quirk.chance else ["agents"],
            "additionalProperties": False,
        }
    return {"type": "object", "properties": known, "additionalProperties": False}


Asked = Annotated[
    bool | float | OfSome,
    BeforeValidator(lambda value: OfSome.model_validate(value) if isinstance(value, Mapping) else value),
]
AskedQuirks = Annotated[dict[str, Asked], WithJsonSchema(_schema())]
"""Quirk -> its value, or which agents have it."""


def check(asked: Mapping[Any, Any]) -> None:
    """Raises ValueError, before anybody looks at agents: which quirks there are, and what their values may be."""
    for name, said in asked.items():
        value = said.get("value", True) if isinstance(said, Mapping) else said
        check_quirk(str(name), value.value if isinstance(value, OfSome) else value)


def of_agent(asked: Mapping[str, bool | float | OfSome], agent_id: int) -> Quirks:
    """What the agent is asked to do wrong: for its mission file."""
    own: Quirks = {}
    for name, value in asked.items():
        if not isinstance(value, OfSome):
            own[name] = value
        elif agent_id in value.agents:
            own[name] = value.value
    return own


def in_words(asked: Mapping[str, bool | float | OfSome]) -> Iterator[str]:
    """For each quirk in force who has it: "crash_on_tie (agents 32 and 122)", "ignore_commit 0.2 (all agents)"."""
    for name, said in asked.items():
        value = said.value if isinstance(said, OfSome) else said
        if value:
            named = name if value is True else f"{name} {value:g}"
            yield f"{named} ({_agents(sorted({*said.agents})) if isinstance(said, OfSome) else 'all agents'})"


def _agents(ids: list[int]) -> str:
    *others, last = map(str, ids)
    return f"agents {', '.join(others)} and {last}" if others else f"agent {last}"


class Security(Model):
    """The mission is secured: datagrams are authentic, confidential and fresh, blocks signed by their makers."""

    keys: Annotated[str, Field(min_length=1, max_length=4000)] = "fresh"
    """`fresh`: each run has keys of its own. Else the directory that `ucp-harness keys new` made, or one of bundles."""
    captured: VehicleId | None = None
    """The vehicle whose keys the rogue node has: what it injects is sealed with them."""
    seal: bool = False
    """Event data is sealed to the depot, too: whoever carries it cannot read it. Blocks have 48 bytes less of it."""


Staggered = Literal["vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s"]
Stagger = dict[Staggered, Annotated[float, Field(ge=0, le=MAX_TIMER_S)]]
"""By how many mission seconds a timer of each agent runs longer than that of the agent before it on the roster."""


def staggered(settings: Settings, stagger: Mapping[Staggered, float], place: int) -> Settings:
    """The settings of the agent at `place` of the roster, from 0. Raises ValueError if a timer gets too long."""
    longer = {name: getattr(settings, name) + step_s * place for name, step_s in stagger.items() if step_s}
    return dataclasses.replace(settings, **longer) if longer else settings


Bytes = bytes
"""A scripted event has a key of that name."""
MAX_DATA_CHARACTERS = 1400
"""What 1024 bytes are in base64, and some more."""


class ScriptedEvent(Model):
    """At `at_s` mission seconds `agent` logs one event with `bytes` bytes of data, all zero.

    Or the event of a flight, word for word: with this `data`, in base64, this `event_id`, and the `timestamp_us` that
    the vehicle's clock showed; without it the event has the time of the agent's clock. If it filled a block that was
    sealed, `sealed` is what that sealed to, in base64: without the vehicle's keys nobody can do it again.
    """

    at_s: Instant
    agent: VehicleId
    bytes: Annotated[int, Field(ge=0, le=1024)] = 256
    event_id: Annotated[int, Field(ge=1, le=254, strict=True)] = 1
    data: Annotated[Data, Field(max_length=MAX_DATA_CHARACTERS)] | None = None
    timestamp_us: Annotated[int, Field(ge=0, lt=2**64, strict=True)] | None = None
    sealed: Annotated[Data, Field(max_length=MAX_DATA_CHARACTERS)] | None = None

    @property
    def event_data(self) -> Bytes:
        return Bytes(self.bytes) if self.data is None else base64.b64decode(self.data)

    @property
    def logged(self) -> LoggableEvent:
        """Of a flight, word for word. It has a timestamp."""
        assert self.timestamp_us is not None, "it is of a flight"
        return LoggableEvent(self.timestamp_us, self.event_id, self.event_data)

    @model_validator(mode="after")
    def _sealed_is_of_a_flight(self) -> "ScriptedEvent":
        if self.sealed is not None and self.timestamp_us is None:
            raise ValueError("`sealed` is of an event of a flight, and that has a `timestamp_us`")
        return self


class Events(Model):
    """Where an agent's loggable events come from.

    `mavlink`: the vehicle's telemetry: the kinds of events in `log`, a position every `position_interval_s` mission
    seconds on average.
    `random`: Algorithm 21, one every `mean_s` mission seconds on average. Without vehicles events are random.
    `scripted`: those of `script`, and no others.
    """

    source: Literal["mavlink", "random", "scripted"] = "mavlink"
    log: Annotated[list[EventKind], Field(min_length=1, max_length=len(EVENT_KINDS))] = list(DEFAULT_LOG)
    position_interval_s: Seconds = 10.0
    mean_s: Annotated[float, Field(ge=1, le=MAX_MEAN_S, allow_inf_nan=False)] = 30.0
    script: Annotated[list[ScriptedEvent], Field(max_length=1_000_000)] = []

    @model_validator(mode="after")
    def _script_is_played(self) -> "Events":
        if self.script and self.source != "scripted":
            raise ValueError(f"`script` needs `source: scripted`, not {self.source}")
        return self


MIN_MEMORY_MIB = 6
"""Docker refuses a container that may use less."""


class Docker(Model):
    """Limits are of each container by itself; none: the machine's. Other backends pass over all of this."""

    image: Annotated[str, Field(min_length=1, max_length=255)] | None = None
    """In which agents run; the project's own, unless given. `agent_command` is a program in it; if that names agents,
    the others do not run in it."""
    image_from_host: bool = False
    """This machine's own programs and packages, read-only, instead of the project's image."""
    memory_mib: Annotated[int, Field(ge=MIN_MEMORY_MIB, strict=True)] | None = None
    cpus: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] | None = None
    """How many processors' worth of time."""
    pids: Annotated[int, Field(ge=1, strict=True)] | None = None
    """How many processes and threads."""
