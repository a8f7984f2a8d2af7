"""What a scenario changes while it runs."""

from typing import Literal

from pydantic import model_validator

from harness.scenario.model import Instant, Model, Probability, VehicleId


class TimelineEntry(Model):
    """At `at_s` mission seconds, one change of the network: a new loss, a partition, or heal."""

    at_s: Instant
    loss: Probability | None = None
    partition: list[list[VehicleId]] | None = None
    heal: Literal[True] | None = None

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        if sum(change is not None for change in (self.loss, self.partition, self.heal)) != 1:
            raise ValueError("needs exactly one of `loss`, `partition` or `heal: true`")
        return self
