"""The radio of a scenario: what it loses over the distance between two vehicles."""

from typing import Annotated

from pydantic import Field, model_validator

from harness.scenario.strict_model import Model
from netem import radio


class HardRange(Model):
    """Whoever is within `range_m` hears everything, whoever is not hears nothing."""

    range_m: float = radio.HardRange.range_m

    @model_validator(mode="after")
    def _means_something(self) -> "HardRange":
        radio.HardRange(self.range_m)
        return self


class LogDistance(Model):
    """Log-distance path loss with shadowing; `netem.radio.LogDistance` says what the figures are and where from."""

    exponent: float = radio.LogDistance.exponent
    shadowing_db: float = radio.LogDistance.shadowing_db
    power_dbm: float = radio.LogDistance.power_dbm
    sensitivity_dbm: float = radio.LogDistance.sensitivity_dbm
    frequency_hz: float = radio.LogDistance.frequency_hz

    @model_validator(mode="after")
    def _means_something(self) -> "LogDistance":
        radio.LogDistance(**self.model_dump())
        return self


class RadioModel(Model):
    """One of `hard_range` and `log_distance`.

    Every `update_s` mission seconds conditions follow the vehicles; as processes, at most ten times a second.
    """

    hard_range: HardRange | None = None
    log_distance: LogDistance | None = None
    update_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0

    def radio(self) -> radio.Radio:
        if self.hard_range is not None:
            return radio.HardRange(self.hard_range.range_m)
        assert self.log_distance is not None
        return radio.LogDistance(**self.log_distance.model_dump())

    @model_validator(mode="after")
    def _one_model(self) -> "RadioModel":
        if (self.hard_range is None) == (self.log_distance is None):
            raise ValueError("needs one of `hard_range` and `log_distance`")
        return self
