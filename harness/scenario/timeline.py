"""What a scenario changes while it runs: the network, and who is alive."""

from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from harness.scenario.model import Instant, Model, VehicleId
from harness.scenario.network import Loss

FaultName = Literal["kill", "restart", "pause", "resume"]
FAULTS: tuple[FaultName, ...] = get_args(FaultName)
FAULT_NEEDS: dict[FaultName, tuple[str, ...]] = {
    "kill": ("running", "paused"),
    "restart": ("killed",),
    "pause": ("running",),
    "resume": ("paused",),
}
FAULT_LEADS_TO: dict[FaultName, str] = {"kill": "killed", "restart": "running", "pause": "paused", "resume": "running"}

Agents = Annotated[list[VehicleId], Field(min_length=1)]


class TimelineEntry(Model):
    """At `at_s` mission seconds, one change: a new loss, a partition, heal; or something happens to agents.

    `kill`: the agents are gone, and all that they held with them (Section 3.3). `restart`: killed agents begin anew,
    holding nothing but the inception block. `pause`: agents stand still, and what reaches them waits until `resume`.
    """

    at_s: Instant
    loss: Loss | None = None
    partition: list[list[VehicleId]] | None = None
    heal: Literal[True] | None = None
    kill: Agents | None = None
    restart: Agents | None = None
    pause: Agents | None = None
    resume: Agents | None = None

    @property
    def fault(self) -> tuple[FaultName, tuple[int, ...]] | None:
        """What happens to which agents, if anything does."""
        for name in FAULTS:
            agents = getattr(self, name)
            if agents is not None:
                return name, tuple(agents)
        return None

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        changes = ("loss", "partition", "heal", *FAULTS)
        if sum(getattr(self, change) is not None for change in changes) != 1:
            raise ValueError(
                "needs exactly one of `loss`, `partition`, `heal: true`, `kill`, `restart`, `pause`, `resume`"
            )
        return self
