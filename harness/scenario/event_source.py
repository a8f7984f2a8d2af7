"""Where loggable events come from."""

import base64
from typing import Annotated, Literal

from pydantic import Field, model_validator

from harness.scenario.strict_model import Data, Instant, Model, Seconds, VehicleId
from ucp.events import MAX_MEAN_S, LoggableEvent
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, EventKind

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
