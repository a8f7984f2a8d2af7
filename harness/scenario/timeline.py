"""What a scenario changes while it runs: the network, who is alive, and what a rogue node sends."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from harness.scenario.injection import (
    INJECTIONS,
    Corrupt,
    Delay,
    Duplicate,
    Flood,
    Forge,
    Injection,
    InjectionName,
    Replay,
)
from harness.scenario.model import Instant, Model, Seconds, VehicleId
from harness.scenario.network import Loss

FaultName = Literal["kill", "crash", "restart", "pause", "resume", "reboot", "boot"]
"""What can happen to agents; `boot` is the end of a `reboot`, and no key of its own."""
FAULTS: tuple[FaultName, ...] = ("kill", "crash", "restart", "pause", "resume", "reboot")
"""Those that are keys of a timeline entry."""
FAULT_NEEDS: dict[FaultName, tuple[str, ...]] = {
    "kill": ("running", "paused"),
    "crash": ("running", "paused"),
    "restart": ("killed",),
    "pause": ("running",),
    "resume": ("paused",),
    "reboot": ("running", "paused"),
    "boot": ("rebooting",),
}
FAULT_LEADS_TO: dict[FaultName, str] = {
    "kill": "killed",
    "crash": "killed",
    "restart": "running",
    "pause": "paused",
    "resume": "running",
    "reboot": "rebooting",
    "boot": "running",
}

Disk = Literal["kept", "lost"]
Agents = Annotated[list[VehicleId], Field(min_length=1)]


class TimelineEntry(Model):
    """At `at_s` mission seconds, one change: a new loss, a partition, heal; something happens to agents; an injection.

    `kill`: they are gone with their vehicles, and all that they held with them (Section 3.3). `crash`: the same, after
    their vehicles have fallen to the ground. `restart`: killed agents begin anew on vehicles at their homes, holding
    nothing but the inception block. `pause`: they stand still, and what reaches them waits until `resume`. `reboot`:
    their computers brown out and are back after `down_s` mission seconds, with what was on their `disk` or with
    nothing; their vehicles fly on. Injections, from `replay` to `flood`: `harness.scenario.injection`.
    """

    at_s: Instant
    loss: Loss | None = None
    partition: list[list[VehicleId]] | None = None
    heal: Literal[True] | None = None
    kill: Agents | None = None
    crash: Agents | None = None
    restart: Agents | None = None
    pause: Agents | None = None
    resume: Agents | None = None
    reboot: Agents | None = None
    down_s: Seconds | None = None
    disk: Disk | None = None
    replay: Replay | None = None
    duplicate: Duplicate | None = None
    delay: Delay | None = None
    corrupt: Corrupt | None = None
    forge: Forge | None = None
    flood: Flood | None = None

    @property
    def injection(self) -> tuple[InjectionName, Injection] | None:
        """What a rogue node sends, if it does."""
        return next(((name, found) for name in INJECTIONS if (found := getattr(self, name)) is not None), None)

    @property
    def fault(self) -> tuple[FaultName, tuple[int, ...]] | None:
        """What happens to which agents, if anything does."""
        for name in FAULTS:
            agents = getattr(self, name)
            if agents is not None:
                return name, tuple(agents)
        return None

    def course(self) -> list[tuple[float, FaultName]]:
        """(mission seconds, what) of all that happens to the agents: a reboot is two things."""
        if self.fault is None:
            return []
        what, _ = self.fault
        return [(self.at_s, what), *([(self.at_s + self.down_s, "boot")] if self.down_s is not None else [])]  # type: ignore[list-item]

    @model_validator(mode="after")
    def _one_change(self) -> "TimelineEntry":
        changes = ("loss", "partition", "heal", *FAULTS, *INJECTIONS)
        if sum(getattr(self, change) is not None for change in changes) != 1:
            named = (f"`{change}{': true' if change == 'heal' else ''}`" for change in changes)
            raise ValueError(f"needs exactly one of {', '.join(named)}")
        if self.reboot is None and (self.down_s is not None or self.disk is not None):
            raise ValueError("`down_s` and `disk` belong to `reboot`")
        if self.reboot is not None and (self.down_s is None or self.disk is None):
            raise ValueError("a reboot needs `down_s`, in mission seconds, and `disk: kept` or `disk: lost`")
        return self
