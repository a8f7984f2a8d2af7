"""The JSON schemas of the input and output lines of an agent in virtual time."""

from ucp.contract.schemas import _chain_export_schema, _control_schema, _mission_schema, _trace_schema
from ucp.contract.schemas._schema_parts import BASE64, EVENT_ID, FLAG, SECONDS, TIMESTAMP, Schema, listed, record
from ucp.mission import LATEST_EPOCH_US

EVENT_TIMESTAMP: Schema = TIMESTAMP | {"maximum": LATEST_EPOCH_US}

COMMANDS = ("status", "stop_events", "reconcile", "export", "quirk", "revoke")
"""The commands that exist both in virtual time and on the control socket. Virtual time also has the command `store`."""


def inputs() -> Schema:
    """Return the JSON schema of an input line."""
    in_virtual_time = {
        "properties": {
            "epoch_us": {"type": "integer"},
            "speedup": {"const": 1},
            "events": {"properties": {"source": {"const": "none"}}},
            "store": {"type": "null"},
        },
        "required": ["epoch_us"],
    }
    start = record(
        {
            "t": SECONDS,
            "mission": {"allOf": [_mission_schema.schema(), in_virtual_time]},
            "trace": FLAG,
            "store": True,
            "bundle": {"type": "object"},
            "boot": {"type": "string", "pattern": "^[0-9a-f]{32}$"},
        },
        optional=("trace", "store", "bundle", "boot"),
    )
    commands = (*COMMANDS, "store")
    keys = _control_schema.REQUESTS | {"store": {}}
    return {
        "oneOf": [
            start,
            record({"t": SECONDS, "datagram": BASE64}),
            record({"t": SECONDS, "event_id": EVENT_ID, "data": BASE64, "timestamp_us": EVENT_TIMESTAMP}),
            record({"t": SECONDS, "timer": {"const": True}}),
            *(record({"t": SECONDS, "command": {"const": name}, **keys[name]}) for name in commands),
        ]
    }


def outputs() -> Schema:
    """Return the JSON schema of an output line."""
    stored = record({**_control_schema.DONE, "store": True})
    answers = [
        *(_control_schema.answer(command) for command in ("status", "stop_events")),
        _chain_export_schema.schema(),
        stored,
    ]
    done = record(
        {
            "sent": listed(BASE64),
            "timer": {"type": ["number", "null"]},
            "trace": listed(_trace_schema.line()),
            "answer": {"anyOf": answers},
        },
        optional=("trace", "answer"),
    )
    refused = record(
        {"error": {"type": "string", "minLength": 1}, "unsupported": {"const": True}}, optional=("unsupported",)
    )
    return {"oneOf": [done, refused]}


def schema() -> Schema:
    """Return the JSON schema of an input together with its output, as in the files of
    `ucp/contract/vectors/missions`.
    """
    return record({"input": {"$ref": "#/$defs/input"}, "output": {"$ref": "#/$defs/output"}}) | {
        "$defs": {"input": inputs(), "output": outputs()}
    }
