"""Describe the agents of a scenario: commands, containers, events, keys, timers and deliberate errors.

    agent_command: [./my_agent, --fast]
    agent_command: {2: [./my_agent, --fast], 5: [./another_agent]}
    quirks: {ignore_commit: 0.2, crash_on_tie: {agents: [32, 122]}}

The mission file of each agent contains only the agent's own settings. An agent does not know the settings of other
agents.
"""

import base64
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, field_validator, model_validator

from harness.scenario.strict_model import Data, MissionSecond, Seconds, StrictModel, VehicleId, VehicleKey
from sitl.address import ListenAddress
from sitl.vehicle import VehicleError
from ucp.block import MAX_AGENT_ID
from ucp.events import MAX_MEAN_S, LoggableEvent
from ucp.quirks import QUIRKS, Quirks, check_quirk
from ucp.settings import MAX_TIMER_S, Settings
from ucp.short_value import shown
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, EventKind

MAX_WORDS = 100
MAX_REMOTE = 100

Command = Annotated[list[str], Field(min_length=1, max_length=MAX_WORDS)]
"""A program that follows ucp/contract/CONTRACT.md, and its arguments. The harness appends the path of the mission
file."""


def _commands(asked: Any) -> Any:
    """Check that the value is a command, or a mapping from agents to commands. Raises ValueError.

    Without this check, pydantic would report one error for each member of the union.
    """
    if isinstance(asked, Mapping):
        for agent, words in asked.items():
            if not _is_agent(agent):
                raise ValueError(f"{shown(agent)} is not an agent ID: use 1..{MAX_AGENT_ID}")
            if not _is_command(words):
                raise ValueError(f"agent {shown(agent)} needs a list of a program and its arguments")
    elif asked is not None and not _is_command(asked):
        raise ValueError("must be a program and its arguments, as a list, or a mapping of agent IDs to such lists")
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


class QuirkOfAgents(StrictModel):
    """A deliberate error (quirk) that only some agents make."""

    agents: Annotated[list[VehicleId], Field(min_length=1)]
    """IDs of the agents that make the mistake."""
    value: bool | float = True
    """true, or a probability from 0 to 1 if the quirk needs one."""


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


QuirkValue = Annotated[
    bool | float | QuirkOfAgents,
    BeforeValidator(lambda value: QuirkOfAgents.model_validate(value) if isinstance(value, Mapping) else value),
]
QuirkValues = Annotated[dict[str, QuirkValue], WithJsonSchema(_schema())]
"""Name of a quirk -> its value for all agents, or the agents that have the quirk."""


def check_quirks(asked: Mapping[Any, Any]) -> None:
    """Raise ValueError if a deliberate error (quirk) of this name does not exist, or if its value is not allowed."""
    for name, quirk in asked.items():
        value = quirk.get("value", True) if isinstance(quirk, Mapping) else quirk
        check_quirk(str(name), value.value if isinstance(value, QuirkOfAgents) else value)


def quirks_of_agent(asked: Mapping[str, bool | float | QuirkOfAgents], agent_id: int) -> Quirks:
    """Return the deliberate errors (quirks) of this agent, as its mission file contains them."""
    own: Quirks = {}
    for name, value in asked.items():
        if not isinstance(value, QuirkOfAgents):
            own[name] = value
        elif agent_id in value.agents:
            own[name] = value.value
    return own


def quirks_in_words(asked: Mapping[str, bool | float | QuirkOfAgents]) -> Iterator[str]:
    """Yield a text for each quirk that is switched on, with its agents, such as "ignore_commit 0.2 (all agents)"."""
    for name, quirk in asked.items():
        value = quirk.value if isinstance(quirk, QuirkOfAgents) else quirk
        if value:
            named = name if value is True else f"{name} {value:g}"
            yield f"{named} ({_agents(sorted({*quirk.agents})) if isinstance(quirk, QuirkOfAgents) else 'all agents'})"


def _agents(ids: list[int]) -> str:
    *others, last = map(str, ids)
    return f"agents {', '.join(others)} and {last}" if others else f"agent {last}"


class SecurityOptions(StrictModel):
    """A secured mission. Agents encrypt each datagram, reject forged and repeated datagrams, and sign their blocks."""

    keys: Annotated[str, Field(min_length=1, max_length=4000)] = "fresh"
    """`fresh`, or a directory. With `fresh`, each run generates its keys. The directory comes from `ucp-harness keys
    new`, or contains bundles.
    """
    fingerprint: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    """Fingerprint of the public keys, as `ucp-harness keys inspect` prints it. The run ends with an error if the
    directory in `keys` contains other keys. By default, the fingerprint is not compared.
    """
    captured: VehicleId | None = None
    """ID of a captured vehicle. The rogue node encrypts its datagrams with the keys of this vehicle. By default, no
    vehicle is captured.
    """
    seal: bool = False
    """True if event data is encrypted for the depot, so that no agent can read the data of other agents. A block then
    has room for 48 bytes less.
    """

    @model_validator(mode="after")
    def _fingerprint_is_of_a_directory(self) -> "SecurityOptions":
        if self.fingerprint is not None and self.keys == "fresh":
            raise ValueError("`fingerprint` needs `keys`, a directory of keys: fresh keys are different in each run")
        return self


Staggered = Literal["vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s"]
Stagger = dict[Staggered, Annotated[float, Field(ge=0, le=MAX_TIMER_S)]]
"""Timer -> number of mission seconds by which this timer of an agent is longer than the same timer of the agent with
the next lower ID.
"""


def staggered(settings: Settings, stagger: Mapping[Staggered, float], place: int) -> Settings:
    """Return the settings of the agent at index `place`. Each timer in `stagger` is longer by `place` times the given
    step. Raises ValueError if a timer is too long.
    """
    longer = {name: getattr(settings, name) + step_s * place for name, step_s in stagger.items() if step_s}
    return dataclasses.replace(settings, **longer) if longer else settings


Bytes = bytes
"""The type `bytes` under a second name, because a key of scripted events is also called `bytes`."""
MAX_DATA_CHARACTERS = 1400
"""Maximum length of event data in base64. It is enough for 1024 bytes."""


class ScriptedEvent(StrictModel):
    """One event that an agent logs. The data of the event are a given number of zero bytes, or the data of a recorded
    event.
    """

    at_s: MissionSecond
    """Mission second at which the agent logs the event."""
    agent: VehicleId
    """ID of the agent."""
    bytes: Annotated[int, Field(ge=0, le=1024)] = 256
    """Number of data bytes, which are all zero. If `data` is given, it is used instead. More than
    `settings.max_event_bytes` allows is an error.
    """
    event_id: Annotated[int, Field(ge=1, le=254, strict=True)] = 1
    """ID of the kind of event."""
    data: Annotated[Data, Field(max_length=MAX_DATA_CHARACTERS)] | None = None
    """Data of a recorded event, in base64."""
    timestamp_us: Annotated[int, Field(ge=0, lt=2**64, strict=True)] | None = None
    """Timestamp of a recorded event in microseconds, in virtual time only. Default: the clock of the agent."""
    sealed: Annotated[Data, Field(max_length=MAX_DATA_CHARACTERS)] | None = None
    """Encrypted event data, in base64, of the block that this recorded event completed. A replay does not have the keys
    to encrypt the data again. The key requires `timestamp_us`.
    """

    @property
    def event_data(self) -> Bytes:
        return Bytes(self.bytes) if self.data is None else base64.b64decode(self.data)

    @property
    def logged(self) -> LoggableEvent:
        """The recorded event. Its `timestamp_us` must be set."""
        assert self.timestamp_us is not None, "it is of a flight"
        return LoggableEvent(self.timestamp_us, self.event_id, self.event_data)

    @model_validator(mode="after")
    def _sealed_data_has_a_timestamp(self) -> "ScriptedEvent":
        if self.sealed is not None and self.timestamp_us is None:
            raise ValueError("`sealed` needs a `timestamp_us`: only recorded events have sealed data")
        return self


class EventOptions(StrictModel):
    """The source of the events that agents log."""

    source: Literal["mavlink", "random", "scripted"] = "mavlink"
    """`mavlink`: telemetry of the vehicle. `random`: Algorithm 21. `scripted`: the events of `script`. Without
    vehicles, `mavlink` means `random`."""
    log: Annotated[list[EventKind], Field(min_length=1, max_length=len(EVENT_KINDS))] = list(DEFAULT_LOG)
    """Kinds of telemetry that become events, for the source `mavlink`."""
    position_interval_s: Seconds = 10.0
    """Mean number of mission seconds between two positions, for the source `mavlink`."""
    mean_s: Annotated[float, Field(ge=1, le=MAX_MEAN_S, allow_inf_nan=False)] = 30.0
    """Mean number of mission seconds between two events, for the source `random`."""
    script: Annotated[list[ScriptedEvent], Field(max_length=1_000_000)] = []
    """Events to log, only for `source: scripted`."""

    @model_validator(mode="after")
    def _script_is_played(self) -> "EventOptions":
        if self.script and self.source != "scripted":
            raise ValueError(f"`script` needs `source: scripted`, not {self.source}")
        return self


class RemoteOptions(StrictModel):
    """Agents that run on other computers, and connect to the run over the network. The run needs the backend
    `process`.
    """

    agents: Annotated[list[VehicleId], Field(min_length=1, max_length=MAX_REMOTE)]
    """IDs of the agents that run on other computers."""
    secret_file: Annotated[str, Field(min_length=1, max_length=4000)]
    """File with the secret that the other computers also have. `ucp-harness join --new-secret FILE` creates the
    file.
    """
    listen: Annotated[str, Field(max_length=300)] | None = None
    """ADDRESS:PORT at which the harness waits for remote agents. Default: the run needs the option `--listen`."""

    @field_validator("listen")
    @classmethod
    def _is_an_address(cls, listen: str | None) -> str | None:
        try:
            return listen and str(ListenAddress.parse(listen))
        except VehicleError:
            raise ValueError(f"must be ADDRESS:PORT, for example 192.168.7.1:14700, not {shown(listen)}") from None

    @field_validator("agents")
    @classmethod
    def _names_each_agent_once(cls, agents: list[int]) -> list[int]:
        if len(set(agents)) < len(agents):
            raise ValueError("names an agent twice")
        return agents


MIN_MEMORY_MIB = 6
"""Minimum memory limit in MiB. Docker refuses a container with a lower limit."""


class DockerOptions(StrictModel):
    """Image and limits of containers. Each limit applies to one container. Other backends ignore these keys."""

    image: Annotated[str, Field(min_length=1, max_length=255)] | None = None
    """Image of the agents. `agent_command` is a program in this image. Agents without a command of their own, and all
    agents by default, run in the image of the project."""
    image_from_host: bool = False
    """True if containers use the programs and packages of this machine, read-only, instead of the project's image."""
    memory_mib: Annotated[int, Field(ge=MIN_MEMORY_MIB, strict=True)] | None = None
    """Maximum memory in MiB. By default, there is no limit."""
    cpus: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] | None = None
    """Maximum processor time per second, as a number of processors. 0.5 is half of one processor. By default, there is
    no limit.
    """
    pids: Annotated[int, Field(ge=1, strict=True)] | None = None
    """Maximum number of processes and threads. By default, there is no limit."""
