"""The JSON schema of a line of a trace (`ucp-trace/2`)."""

from ucp.agent import HANDLERS, ON_LOCAL_EVENT, ON_MESSAGE, ON_TIMER
from ucp.contract.schemas._mission_schema import settings
from ucp.contract.schemas._schema_parts import (
    AGENT_ID,
    BASE64,
    COUNT,
    EVENT_ID,
    FLAG,
    HASH,
    ROSTER,
    SECONDS,
    TIMESTAMP,
    Schema,
    listed,
    record,
)
from ucp.trace import SCHEMA

OPERATIONS = ("complete", "chain+", "chain-", "deque+", "deque-", "stack+", "stack-")
DROPS = (
    "truncated",
    "oversized",
    "wrong magic",
    "wrong version",
    "impossible sender",
    "wrong length",
    "unknown type",
    "bad vote",
    "impossible agent",
    "own sender",
    "sender not on the roster",
    "block not of the roster",
)
"""Reasons why an agent drops a datagram."""

SECURED_DROPS = (
    "not secured",
    "revoked sender",
    "epoch out of range",
    "old boot",
    "replayed",
    "not authentic",
    "not signed by its sender",
    "answers no request",
    "block not signed by its maker",
    "not signed by the authority",
    "known already",
    "not confirmed",
    "too many wrong signatures",
    "too many unknown boots",
)
"""Further reasons why an agent of a secured mission drops a datagram."""


def header() -> Schema:
    """Return the JSON schema of a trace header, the first line after each start of an agent."""
    clock = record({"epoch_us": COUNT, "speedup": {"type": "number", "exclusiveMinimum": 0}})
    return record(
        {
            "schema": {"const": SCHEMA},
            "agent_id": AGENT_ID,
            "roster": ROSTER,
            "initial_data": BASE64,
            "settings": settings(optional=False),
            "clock": clock,
            "secured": {"const": True},
        },
        optional=("secured",),
    )


def trigger() -> Schema:
    """Return the JSON schema of a trigger, the reason why a handler runs."""
    names = {"enum": [message.NAME for message in ON_MESSAGE]}
    kinds = (
        {"message": names, "from": AGENT_ID, "seq": COUNT},
        {"timer": {"enum": list(ON_TIMER)}},
        {"event": EVENT_ID},
        {"local": {"enum": list(HANDLERS)}},
        {"operator": {"const": "reconcile"}},
        {"boot": COUNT},
    )
    return {"oneOf": [record(kind, closed=True) for kind in kinds]}


def handler_run() -> Schema:
    """Return the JSON schema of a handler run. Its algorithm and branch must belong to its handler."""
    sent = record(
        {
            "message": {"enum": [message.NAME for message in ON_MESSAGE]},
            "seq": COUNT,
            "block": {"anyOf": [HASH, {"type": "null"}]},
            "datagram": BASE64,
        }
    )
    votes = record({"yes": COUNT, "no": COUNT}, closed=True)
    candidate: Schema = {
        "type": "array",
        "prefixItems": [{"type": "integer", "minimum": 1}, TIMESTAMP],
        "items": False,
        "minItems": 2,
    }
    candidates: Schema = {
        "type": "object",
        "patternProperties": {"^([0-9a-f]{64})?$": candidate},
        "additionalProperties": False,
    }
    chosen: Schema = {
        "type": "object",
        "patternProperties": {"^([0-9a-f]{64})?$": COUNT},
        "additionalProperties": False,
        "maxProperties": 1,
    }
    change: Schema = {
        "type": "array",
        "prefixItems": [{"enum": list(OPERATIONS)}, HASH],
        "items": False,
        "minItems": 2,
    }
    state = record({"chain": COUNT, "deque": COUNT, "stack": COUNT, "reconciling": FLAG, "idle": FLAG, "top": HASH})
    started = {"type": "object", "properties": dict.fromkeys(ON_TIMER, SECONDS), "additionalProperties": False}
    run = record(
        {
            "t": SECONDS,
            "handler": {"enum": list(HANDLERS)},
            "algorithm": {"type": "integer", "minimum": 1, "maximum": len(HANDLERS)},
            "trigger": trigger(),
            "input": BASE64,
            "branch": {"type": "string"},
            "changes": listed(change),
            "sent": listed(sent),
            "tally": {"anyOf": [votes, candidates, chosen]},
            "started": started,
            "sealed": BASE64,
            "state": state,
        },
        optional=("input", "tally", "started", "sealed"),
    )
    with_input = {"anyOf": [{"required": [kind]} for kind in ("message", "event", "boot")]}
    return run | {
        "allOf": [
            *(
                {
                    "if": {"properties": {"handler": {"const": handler.name}}},
                    "then": {
                        "properties": {
                            "algorithm": {"const": handler.algorithm},
                            "branch": {"enum": list(handler.branches)},
                        }
                    },
                }
                for handler in HANDLERS.values()
            ),
            *(
                {
                    "if": {
                        "properties": {"trigger": {"required": ["message"], "properties": {"message": {"const": m}}}}
                    },
                    "then": {"properties": {"handler": {"const": handler}}},
                }
                for m, handler in ((message.NAME, handler.name) for message, handler in ON_MESSAGE.items())
            ),
            *(
                {
                    "if": {
                        "properties": {"trigger": {"required": ["timer"], "properties": {"timer": {"const": timer}}}}
                    },
                    "then": {"properties": {"handler": {"const": handler.name}}},
                }
                for timer, handler in ON_TIMER.items()
            ),
            {
                "if": {"properties": {"trigger": {"required": ["local"]}}},
                "then": {"properties": {"handler": {"enum": [handler.name for handler in ON_LOCAL_EVENT.values()]}}},
            },
            {
                "if": {"properties": {"trigger": with_input}},
                "then": {"required": ["input"]},
                "else": {"properties": {"input": False}},
            },
        ]
    }


def aside() -> Schema:
    """Return the JSON schema of trace lines that are no handler runs: dropped datagrams and commands."""
    return {
        "oneOf": [
            record(
                {"t": SECONDS, "dropped": {"enum": [*DROPS, *SECURED_DROPS]}, "datagram": BASE64, "count": COUNT},
                optional=("count",),
            ),
            record({"t": SECONDS, "command": {"type": "string"}, "request": {"type": "object"}}),
        ]
    }


def line() -> Schema:
    """Return the JSON schema of any line of a trace."""
    return {"oneOf": [header(), handler_run(), *aside()["oneOf"]]}


def schema() -> Schema:
    """Return the JSON schema of a trace line, with title and description."""
    return line()
