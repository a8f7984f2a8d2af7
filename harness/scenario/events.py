"""Where loggable events come from."""

from typing import Annotated, Literal

from pydantic import Field

from harness.scenario.model import Model, Seconds


class Events(Model):
    """Where an agent's loggable events come from.

    `mavlink`: the vehicle's telemetry, a position every `position_interval_s` mission seconds on average.
    `random`: Algorithm 21, one every `mean_s` mission seconds on average. Without vehicles events are random.
    """

    source: Literal["mavlink", "random"] = "mavlink"
    position_interval_s: Seconds = 10.0
    mean_s: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 30.0
