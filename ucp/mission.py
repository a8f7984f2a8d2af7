"""Read the mission file of an agent (schema `ucp-mission/1`, see contract/CONTRACT.md)."""

import base64
import socket
import sys
from pathlib import Path
from typing import Any, Literal, TypeGuard, get_args

from ucp._dataclass import dataclass
from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES
from ucp.events import DEFAULT_LOG, MAX_MEAN_S, MEAN_TIME_BETWEEN_EVENTS_S, EventKind
from ucp.features import FEATURES
from ucp.plain_file import json_problem, read_json
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.settings import Settings
from ucp.short_value import shown, shown_key

SCHEMA = "ucp-mission/1"
MAX_MISSION_BYTES = 4 * 1024 * 1024
MAX_INITIAL_DATA_BYTES = 512 * 1024
"""Maximum size of the initial data. The first line of a trace contains them in base64, and readers accept lines of at
most 16 MiB.
"""
MAX_SPEEDUP = 1000.0
LATEST_EPOCH_US = 2**63 - 1
"""Latest start of a mission, in microseconds since the Unix epoch. The timestamps of such a mission still fit into the
64 bits of a block timestamp.
"""
MAX_NAME = 40
"""Maximum number of characters of an unknown name in an error message."""


class MissionError(Exception):
    """An error: a mission file cannot be used. The message names the file, the key and the allowed values."""


class UnsupportedMissionError(MissionError):
    """An error: a mission needs a feature that this agent does not have."""


@dataclass(frozen=True)
class Network:
    """The network settings of an agent. `address` is its own IPv4 address, whose datagrams it ignores."""

    address: str
    broadcast: str
    port: int


@dataclass(frozen=True)
class EventSource:
    """The source of an agent's events: Algorithm 21 ("random"), the telemetry of the vehicle ("mavlink"), or none
    ("none").
    """

    source: Literal["random", "mavlink", "none"] = "random"
    mean_s: float = MEAN_TIME_BETWEEN_EVENTS_S
    position_interval_s: float = 10.0
    log: tuple[EventKind, ...] = DEFAULT_LOG
    vehicle_host: str = "127.0.0.1"
    vehicle_port: int = 5762


@dataclass(frozen=True)
class Security:
    """The key settings of a secured mission. `bundle` is the key file, relative to the directory of the mission
    file.
    """

    bundle: str


@dataclass(frozen=True)
class Mission:
    """The content of a mission file."""

    agent_id: int
    roster: tuple[int, ...]
    initial_data: bytes
    network: Network
    events: EventSource
    settings: Settings
    quirks: dict[str, bool | float]
    seed: int
    speedup: float
    """Number of mission seconds per second of wall time."""
    epoch_us: int | None
    """Start of the mission in microseconds since the Unix epoch. If it is None, the agent waits for the command
    `start`.
    """
    store: str | None = None
    """File of the agent's store, relative to the directory of the mission file. None if the agent has no store."""
    security: Security | None = None


def load_mission(path: Path) -> Mission:
    """Read a mission file. Raises MissionError."""
    try:
        document = read_json(path, MAX_MISSION_BYTES)
    except OSError as error:
        raise MissionError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise MissionError(f"{path}: {json_problem(error)}") from None
    try:
        return parse_mission(document)
    except MissionError as error:
        raise type(error)(f"{path}: {error}") from None


def parse_mission(document: Any) -> Mission:
    """Parse a mission. Raises MissionError, or UnsupportedMissionError if it needs a feature that this agent lacks."""
    if not isinstance(document, dict):
        raise MissionError("not a mission: it must be a JSON object")
    if document.get("schema") != SCHEMA:
        raise MissionError(f"`schema` is {shown(document.get('schema'))}, and this agent reads {SCHEMA!r}")
    _check_features(document.get("features", []))
    agent_id = _integer(document, "agent_id", 1, MAX_AGENT_ID)
    roster = _get(document, "roster", list)
    if not roster or not all(type(member) is int and 1 <= member <= MAX_AGENT_ID for member in roster):
        raise MissionError(f"`roster` must list agent IDs 1..{MAX_AGENT_ID}")
    if agent_id not in roster:
        raise MissionError(f"`agent_id` {agent_id} is not on the `roster`")
    epoch_us = document.get("epoch_us")
    if epoch_us is not None and not is_epoch(epoch_us):
        raise MissionError("`epoch_us` must be microseconds since the Unix epoch, or null to wait for `start`")
    store = document.get("store")
    if store is not None and not (isinstance(store, str) and store.isprintable() and store):
        raise MissionError("`store` must be the path of a file, or null to keep nothing on disk")
    initial_data, settings = _initial_data(document), _settings(document.get("settings", {}))
    security = _security(document.get("security"))
    if sealed_to(initial_data) is not None:
        if security is None:
            raise MissionError("`initial_data` ends in a depot's key, so `security` is needed to seal event data")
        if settings.max_block_bytes > (most := MAX_EVENT_DATA_BYTES - SEAL_BYTES):
            raise MissionError(f"`settings.max_block_bytes` must be at most {most} with sealed event data")
    return Mission(
        agent_id=agent_id,
        roster=tuple(dict.fromkeys(roster)),
        initial_data=initial_data,
        network=_network(_get(document, "network", dict)),
        events=_event_source(_get(document, "events", dict)),
        settings=settings,
        quirks=_quirks(document.get("quirks", {})),
        seed=_integer(document, "seed", 0, 2**64 - 1),
        speedup=_positive(document, "speedup", MAX_SPEEDUP),
        epoch_us=epoch_us,
        store=store,
        security=security,
    )


def is_epoch(value: object) -> TypeGuard[int]:
    """Return true if this value is a valid start of a mission, in microseconds since the Unix epoch."""
    return type(value) is int and 0 <= value <= LATEST_EPOCH_US


def _check_features(features: Any) -> None:
    if not isinstance(features, list) or not all(isinstance(feature, str) for feature in features):
        raise MissionError("`features` must list names of features")
    for feature in features:
        if feature not in FEATURES:
            name = feature[:MAX_NAME]
            raise UnsupportedMissionError(f"needs the feature {name!r}, and this agent has {', '.join(FEATURES)}")


def _get(document: dict[str, Any], key: str, kind: type) -> Any:
    value = document.get(key)
    if not isinstance(value, kind):
        raise MissionError(f"`{key}` is missing or not a JSON {'object' if kind is dict else kind.__name__}")
    return value


def _integer(document: dict[str, Any], key: str, low: int, high: int, within: str = "") -> int:
    value = document.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise MissionError(f"`{within}{key}` must be a whole number {low}..{high}, not {shown(value)}")
    return value


def _positive(document: dict[str, Any], key: str, most: float = sys.float_info.max, within: str = "") -> float:
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value <= most:
        at_most = f", at most {most:g}" if most < sys.float_info.max else ""
        raise MissionError(f"`{within}{key}` must be a number above 0{at_most}, not {shown(value)}")
    return float(value)


def _initial_data(document: dict[str, Any]) -> bytes:
    try:
        initial_data = base64.b64decode(_get(document, "initial_data", str), validate=True)
    except ValueError as error:
        raise MissionError(f"`initial_data` is not base64: {error}") from None
    if len(initial_data) > MAX_INITIAL_DATA_BYTES:
        raise MissionError(f"`initial_data` is {len(initial_data)} bytes, more than {MAX_INITIAL_DATA_BYTES}")
    return initial_data


def _network(document: dict[str, Any]) -> Network:
    for key in ("address", "broadcast"):
        try:
            socket.inet_pton(socket.AF_INET, str(document.get(key)))
        except (OSError, ValueError):
            raise MissionError(f"`network.{key}` must be an IPv4 address, not {shown(document.get(key))}") from None
    return Network(document["address"], document["broadcast"], _integer(document, "port", 1, 65535, "network."))


def _event_source(document: dict[str, Any]) -> EventSource:
    usual = EventSource()
    document = {name: getattr(usual, name) for name in usual.__match_args__} | _known(document, "events", EventSource)
    if document["source"] not in ("random", "mavlink", "none"):
        raise MissionError(f"`events.source` must be random, mavlink or none, not {shown(document['source'])}")
    return EventSource(
        document["source"],
        max(1.0, _positive(document, "mean_s", MAX_MEAN_S, "events.")),
        _positive(document, "position_interval_s", within="events."),
        _log(document["log"]),
        _host(document["vehicle_host"]),
        _integer(document, "vehicle_port", 1, 65535, "events."),
    )


def _host(name: Any) -> str:
    labels = name.removesuffix(".").split(".") if isinstance(name, str) and name.isprintable() else [""]
    if not all(0 < len(label) < 64 for label in labels):
        raise MissionError(f"`events.vehicle_host` must be an address or the name of a host, not {shown(name)}")
    return str(name)


def _log(kinds: Any) -> tuple[EventKind, ...]:
    known = get_args(EventKind)
    if not isinstance(kinds, list | tuple) or not all(kind in known for kind in kinds):
        raise MissionError(f"`events.log` must list kinds of events ({', '.join(known)}), not {shown(kinds)}")
    return tuple(kinds)


def _settings(document: Any) -> Settings:
    try:
        return Settings(**_known(document, "settings", Settings))
    except (TypeError, ValueError) as error:
        raise MissionError(f"`settings`: {error}") from None


def _security(document: Any) -> Security | None:
    if document is None:
        return None
    bundle = document.get("bundle") if isinstance(document, dict) else None
    if not (isinstance(bundle, str) and bundle.isprintable() and bundle):
        raise MissionError("`security` must have the path of a file with keys as its `bundle`, or be null")
    return Security(bundle)


def _quirks(document: Any) -> dict[str, bool | float]:
    if not isinstance(document, dict):
        raise MissionError("`quirks` must be a JSON object")
    asked = {name: value for name, value in document.items() if value is not False and value != 0}
    if asked:
        from ucp.quirks import UnknownQuirkError, check_quirk  # correct agents do not load quirks

        try:
            for name, value in asked.items():
                check_quirk(name, value)
        except UnknownQuirkError as error:
            raise UnsupportedMissionError(f"`quirks`: {error}") from None
        except ValueError as error:
            raise MissionError(f"`quirks`: {error}") from None
    return document


def _known(document: Any, key: str, kind: type[EventSource] | type[Settings]) -> dict[str, Any]:
    if not isinstance(document, dict):
        raise MissionError(f"`{key}` must be a JSON object")
    names = kind.__match_args__
    for name in document:
        if name not in names:
            raise MissionError(f"`{key}.{shown_key(name)}` is unknown: there are {', '.join(names)}")
    return document
