"""The JSON schema of the mission file (`ucp-mission/1`)."""

import dataclasses

from ucp.contract.schemas._schema_parts import AGENT_ID, BASE64, FLAG, ROSTER, Schema, listed, record
from ucp.events import MAX_MEAN_S
from ucp.mission import LATEST_EPOCH_US, MAX_SPEEDUP, SCHEMA
from ucp.settings import ADDED, DECLARED, ChoiceSetting, NumberSetting, Settings
from ucp.telemetry import EVENT_KINDS

ABOVE_0: Schema = {"type": "number", "exclusiveMinimum": 0}
OCTET = "(25[0-5]|2[0-4][0-9]|1[0-9]{2}|[1-9]?[0-9])"
IPV4: Schema = {"type": "string", "format": "ipv4", "pattern": rf"^{OCTET}(\.{OCTET}){{3}}$"}
PORT: Schema = {"type": "integer", "minimum": 1, "maximum": 65535}


def _setting(declared: NumberSetting | ChoiceSetting) -> Schema:
    if isinstance(declared, ChoiceSetting):
        return FLAG if declared.values == (False, True) else {"enum": list(declared.values)}
    if declared.whole:
        return {"type": "integer", "minimum": declared.low, "maximum": declared.high}
    low: Schema = ABOVE_0 if declared.low > 0 else {"type": "number", "minimum": 0}
    return low | {"maximum": declared.high}


def settings(*, optional: bool) -> Schema:
    """Return the JSON schema of the settings with their defaults. If `optional` is true, every setting may be
    missing.
    """
    defaults = dataclasses.asdict(Settings())
    named = {name: {**_setting(declared), "default": defaults[name]} for name, declared in DECLARED.items()}
    return record(named, optional=tuple(named) if optional else ADDED)


def events() -> Schema:
    """Return the JSON schema of the event source."""
    optional: Schema = {
        "mean_s": ABOVE_0 | {"maximum": MAX_MEAN_S},
        "position_interval_s": ABOVE_0,
        "log": listed({"enum": list(EVENT_KINDS)}),
        "vehicle_host": {"type": "string", "minLength": 1},
        "vehicle_port": PORT,
    }
    return record({"source": {"enum": ["random", "mavlink", "none"]}, **optional}, optional=tuple(optional))


def schema() -> Schema:
    """Return the JSON schema of a mission file."""
    return record(
        {
            "schema": {"const": SCHEMA},
            "contract": {"type": "integer", "minimum": 1},
            "features": listed({"type": "string"}),
            "agent_id": AGENT_ID,
            "roster": ROSTER,
            "initial_data": BASE64,
            "network": record({"address": IPV4, "broadcast": IPV4, "port": PORT}),
            "events": events(),
            "settings": settings(optional=True),
            "quirks": {"type": "object", "additionalProperties": {"type": ["boolean", "number"]}},
            "seed": {"type": "integer", "minimum": 0, "maximum": 2**64 - 1},
            "speedup": ABOVE_0 | {"maximum": MAX_SPEEDUP},
            "epoch_us": {"type": ["integer", "null"], "minimum": 0, "maximum": LATEST_EPOCH_US},
            "store": {"type": ["string", "null"], "minLength": 1},
            "security": {"oneOf": [{"type": "null"}, record({"bundle": {"type": "string", "minLength": 1}})]},
        },
        optional=("contract", "features", "settings", "quirks", "epoch_us", "store", "security"),
    )
