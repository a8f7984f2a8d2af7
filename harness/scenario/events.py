"""Where loggable events come from."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from harness.scenario.model import Instant, Model, Seconds, VehicleId
from ucp.telemetry import DEFAULT_LOG, EVENT_KINDS, EventKind


class ScriptedEvent(Model):
    """At `at_s` mission seconds `agent` logs one event with `bytes` bytes of data, all zero."""

    at_s: Instant
    agent: VehicleId
    bytes: Annotated[int, Field(ge=0, le=1024)] = 256


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
    mean_s: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 30.0
    script: Annotated[list[ScriptedEvent], Field(max_length=1_000_000)] = []

    @model_validator(mode="after")
    def _script_is_played(self) -> "Events":
        if self.script and self.source != "scripted":
            raise ValueError(f"`script` needs `source: scripted`, not {self.source}")
        return self
