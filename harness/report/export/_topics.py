"""Convert recorded values to JSON objects for plots. Each kind of value has a topic with a JSON schema.

If a value is unknown, its key is omitted, because plotting tools do not support null. Each object also contains the
mission second.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from harness.archive.connectivity import Link
from harness.report.export._exported_run import ExportedRun
from harness.report.export._samples import (
    DropSample,
    HandlerRunSample,
    LossSample,
    MessageSample,
    NetworkSample,
    ReconcileSample,
    ReplicationSample,
    Sample,
    TelemetrySample,
    VoteSample,
)
from ucp.trace import HandlerRun
from ucp.trigger import MessageTrigger

Object = dict[str, Any]
Schema = dict[str, Any]

_NUMBER, _WHOLE, _YES_OR_NO, _TEXT = ({"type": name} for name in ("number", "integer", "boolean", "string"))
_AGENTS = {"type": "array", "items": _WHOLE}
_LARGEST = 2**53
"""The largest integer that every tool shows exactly. Some tools store all numbers as floats, and floats cannot
represent all larger integers.
"""


def schema(**properties: Schema) -> Schema:
    """Return the JSON schema of an object with these keys. All keys are optional."""
    return {"type": "object", "properties": {"mission_s": _NUMBER, **properties}}


_CHANGES = {"type": "array", "items": schema(operation=_TEXT, block=_TEXT, block_hash=_TEXT)}
_SENT = {"type": "array", "items": schema(message=_TEXT, seq=_WHOLE, block=_TEXT, block_hash=_TEXT)}
_PHASES = {"type": "array", "items": schema(name=_TEXT, start_s=_NUMBER, end_s=_NUMBER, rounds=_WHOLE)}

SCHEMAS: dict[str, Schema] = {
    "ucp.AgentState": schema(
        chain=_WHOLE, deque=_WHOLE, stack=_WHOLE, reconciling=_YES_OR_NO, idle=_YES_OR_NO, top_chain_hash=_TEXT
    ),
    "ucp.ChainChange": schema(length=_WHOLE, operation=_TEXT, block=_TEXT, block_hash=_TEXT, handler=_TEXT),
    "ucp.HandlerRun": schema(
        handler=_TEXT,
        algorithm=_WHOLE,
        branch=_TEXT,
        trigger=_TEXT,
        trigger_name=_TEXT,
        sender=_WHOLE,
        seq=_WHOLE,
        changes=_CHANGES,
        sent=_SENT,
    ),
    "ucp.RefusedDatagram": schema(reason=_TEXT),
    "ucp.Message": schema(
        sender=_WHOLE, message=_TEXT, block=_TEXT, block_hash=_TEXT, received_by=_AGENTS, receivers=_WHOLE
    ),
    "ucp.Vote": schema(block=_TEXT, block_hash=_TEXT, start_s=_NUMBER, duration_s=_NUMBER, outcome=_TEXT),
    "ucp.Reconcile": schema(start_s=_NUMBER, duration_s=_NUMBER, reason=_TEXT, done=_YES_OR_NO, phases=_PHASES),
    "ucp.Network": schema(groups=_WHOLE, largest_group=_WHOLE, connected=_TEXT, mean_loss=_NUMBER, worst_loss=_NUMBER),
    "ucp.Replication": schema(
        mutual_chain=_WHOLE, longest_chain=_WHOLE, distinct_chains=_WHOLE, copies_min=_WHOLE, copies_mean=_NUMBER
    ),
}


class TopicConverter:
    """A converter from recorded values to JSON objects. `schemas` contains the JSON schemas of these objects,
    by name.
    """

    def __init__(self, recording: ExportedRun) -> None:
        self._recording = recording
        self._state: dict[int, Any] = {}
        self.schemas = dict(SCHEMAS)
        links = {_link((sender, to)): _NUMBER for sender in recording.agents for to in recording.agents if sender != to}
        self.schemas["ucp.LinkLosses"] = schema(**links)

    def of(self, sample: Sample) -> Iterator[tuple[str, str, Object]]:
        """Yield (topic, name of the schema, JSON object) for each part of a recorded value."""
        for topic, name, values in self._of(sample):
            known = {key: value for key, value in values.items() if _is_plottable(value)}
            yield topic, name, {"mission_s": round(self._recording.time.mission_s(sample.at_ns), 6), **known}

    def _of(self, sample: Sample) -> Iterator[tuple[str, str, Object]]:
        match sample:
            case HandlerRunSample(agent=agent, run=run):
                yield f"/agents/{agent}/handler_runs", "ucp.HandlerRun", self._run(run)
                yield from self._chain(agent, run)
                if self._state.get(agent) != run.state:
                    self._state[agent] = run.state
                    yield f"/agents/{agent}/state", "ucp.AgentState", _state(run)
            case DropSample(agent=agent, reason=reason):
                yield f"/agents/{agent}/refused", "ucp.RefusedDatagram", {"reason": reason}
            case MessageSample(message=message):
                receivers = sorted({agent for agent, _ in message.receipts})
                values = {"sender": message.sender, "message": message.name, **self._block(message.block)}
                yield "/messages", "ucp.Message", values | {"received_by": receivers, "receivers": len(receivers)}
            case VoteSample(vote=vote):
                values = {"start_s": vote.start_s, "duration_s": vote.end_s - vote.start_s, "outcome": vote.outcome}
                yield f"/agents/{vote.agent}/votes", "ucp.Vote", self._block(vote.block) | values
            case ReconcileSample(reconcile=reconcile):
                values = {
                    "start_s": reconcile.start_s,
                    "duration_s": reconcile.end_s - reconcile.start_s,
                    "reason": reconcile.reason,
                    "done": reconcile.done,
                    "phases": [
                        {"name": phase.name, "start_s": phase.start_s, "end_s": phase.end_s, "rounds": phase.rounds}
                        for phase in reconcile.phases
                    ],
                }
                yield f"/agents/{reconcile.agent}/reconciles", "ucp.Reconcile", values
            case NetworkSample(groups=groups):
                values = {
                    "groups": len(groups),
                    "largest_group": max(map(len, groups), default=0),
                    "connected": " | ".join(" ".join(map(str, sorted(group))) for group in groups),
                    "mean_loss": sample.mean_loss,
                    "worst_loss": sample.worst_loss,
                }
                yield "/network/state", "ucp.Network", values
            case LossSample(losses=losses):
                yield "/network/losses", "ucp.LinkLosses", {_link(link): loss for link, loss in losses.items()}
            case ReplicationSample(replication=replication):
                values = {
                    "mutual_chain": replication.mutual_chain,
                    "longest_chain": replication.longest_chain,
                    "distinct_chains": replication.distinct_chains,
                    "copies_min": replication.copies_min,
                    "copies_mean": replication.copies_mean,
                }
                yield "/swarm/replication", "ucp.Replication", values
            case TelemetrySample(vehicle=vehicle, message=message):
                kind = message.get_type()
                name = f"mavlink.{kind}"
                if name not in self.schemas:
                    self.schemas[name] = _mavlink_schema(type(message))
                yield f"/vehicles/{vehicle}/mavlink/{kind}", name, _mavlink(message)

    def _run(self, run: HandlerRun) -> Object:
        trigger, name = next(iter(run.trigger.to_json().items()), (None, None))
        received = run.trigger if isinstance(run.trigger, MessageTrigger) else None
        return {
            "handler": run.handler,
            "algorithm": _exact_integer(run.algorithm),
            "branch": run.branch,
            "trigger": trigger,
            "trigger_name": None if name is None else str(name),
            "sender": _exact_integer(received and received.sender),
            "seq": _exact_integer(received and received.sequence),
            "changes": [{"operation": operation, **self._block(block)} for operation, block in run.changes],
            "sent": [
                {"message": sent.message, "seq": _exact_integer(sent.seq), **self._block(sent.block)}
                for sent in run.sent
            ],
        }

    def _chain(self, agent: int, run: HandlerRun) -> Iterator[tuple[str, str, Object]]:
        changes = [(operation, block) for operation, block in run.changes if operation in ("chain+", "chain-")]
        length = run.state.chain - sum(1 if operation == "chain+" else -1 for operation, _ in changes)
        for operation, block in changes:
            length += 1 if operation == "chain+" else -1
            values = {"length": _exact_integer(length), "operation": "added" if operation == "chain+" else "taken off"}
            yield f"/agents/{agent}/chain", "ucp.ChainChange", values | self._block(block) | {"handler": run.handler}

    def _block(self, block_hash: str | None) -> Object:
        return {"block": self._recording.block(block_hash), "block_hash": block_hash} if block_hash else {}


def _is_plottable(value: Any) -> bool:
    """Return true if the value is known, and JSON can represent it."""
    return math.isfinite(value) if isinstance(value, float) else value is not None


def _state(run: HandlerRun) -> Object:
    state = run.state
    return {
        "chain": _exact_integer(state.chain),
        "deque": _exact_integer(state.deque),
        "stack": _exact_integer(state.stack),
        "reconciling": state.reconciling,
        "idle": state.idle,
        "top_chain_hash": state.top,
    }


def _link(link: Link) -> str:
    return f"loss_{link[0]}_to_{link[1]}"


def _exact_integer(number: Any) -> int | None:
    """Return the number if it is an integer that all tools show exactly. Return None for any other number."""
    return number if isinstance(number, int) and abs(number) <= _LARGEST else None


# MAVLink messages, from pymavlink's description of the dialect


def _mavlink_schema(message: type[Any]) -> Schema:
    fields = zip(message.fieldnames, message.fieldtypes, _lengths(message), strict=True)
    return schema(**{name: _field_schema(kind, length) for name, kind, length in fields})


def _lengths(message: type[Any]) -> Iterable[int]:
    """Return the number of array elements for each field of a MAVLink message. The number is 0 if the field is not an
    array.
    """
    in_order: Mapping[str, int] = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
    return [in_order[name] for name in message.fieldnames]


def _field_schema(kind: str, length: int) -> Schema:
    if kind == "char":
        return _TEXT
    one = _NUMBER if kind in ("float", "double") else _WHOLE
    return {"type": "array", "items": one} if length else one


def _mavlink(message: Any) -> Object:
    return {name: _field(getattr(message, name)) for name in message.fieldnames}


def _field(raw: Any) -> Any:
    if isinstance(raw, list | tuple):
        return [0.0 if isinstance(part, float) and not math.isfinite(part) else part for part in raw]
    return raw.decode("utf-8", "replace") if isinstance(raw, bytes) else raw
