"""Faults that end, pause or restart agents and their vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.scenario.faults.fault import (
    ARROW,
    BARS,
    CROSS,
    DIAMOND,
    KILLED,
    PAUSED,
    REBOOTING,
    RUNNING,
    SQUARE,
    SWITCHED_OFF,
    AgentOperations,
    DiskState,
    Fault,
)
from harness.scenario.strict_model import Seconds
from harness.scenario.vehicles import Vehicles


class Crash(Fault):
    """The vehicles of these agents fall to the ground. The agents end as with `kill`."""

    what = "crash"
    states_before = (RUNNING, PAUSED)
    state_after = KILLED
    ends_incarnation = True
    removes_vehicle = True
    mark = CROSS
    meaning = "lost"

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles that can fall, but `vehicles.kind` is none: use `kill` instead")

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.fall(agent_id)
        await operations.end_incarnation(agent_id)


class Kill(Fault):
    """These agents end, with their vehicles and all their data (Section 3.3)."""

    what = "kill"
    states_before = (RUNNING, PAUSED)
    state_after = KILLED
    ends_incarnation = True
    removes_vehicle = True
    mark = CROSS
    meaning = "lost"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.end_incarnation(agent_id, with_vehicle=True)


class Pause(Fault):
    """These agents stop. Their incoming messages wait until `resume`."""

    what = "pause"
    states_before = (RUNNING,)
    state_after = PAUSED
    suspends_agent = True
    mark = BARS
    meaning = "paused"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.pause(agent_id)


@dataclass(frozen=True)
class Reboot(Fault):
    """The computers of these agents fail, and start again after `down_s`, with or without the data on their disks."""

    down_s: Seconds
    disk: DiskState

    key_descriptions = {
        "down_s": "Mission seconds until the agents of `reboot` start again.",
        "disk": "Whether the agents of `reboot` start with the data on their disks, or with the inception block only.",
    }
    what = "reboot"
    states_before = (RUNNING, PAUSED)
    state_after = REBOOTING
    ends_incarnation = True
    default_values = {"down_s": 30.0, "disk": "kept"}
    keys_in_words = "`down_s`, in mission seconds, and `disk: kept` or `disk: lost`"
    mark = DIAMOND
    meaning = "reboots"

    @property
    def disk_after(self) -> DiskState:
        return self.disk

    def stages(self) -> Sequence[Fault]:
        return [self, Boot(self.at_s + self.down_s, self.agents, self.disk)]

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.end_incarnation(agent_id, disk_kept=self.disk == "kept")


@dataclass(frozen=True)
class Boot(Fault):
    """The end of a reboot."""

    disk: DiskState

    what = "boot"
    is_timeline_key = False
    states_before = (REBOOTING,)
    begins_incarnation = True
    mark = ARROW
    meaning = "goes on, or begins anew"

    @property
    def disk_after(self) -> DiskState:
        return self.disk

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.begin_incarnation(agent_id)


class Restart(Fault):
    """These killed agents start again, on new vehicles at their homes, with the inception block only."""

    what = "restart"
    states_before = (KILLED,)
    begins_incarnation = True
    adds_vehicle = True
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.begin_incarnation(agent_id, new_vehicle=True)


class Resume(Fault):
    """These paused agents continue, and receive the messages that arrived during the pause."""

    what = "resume"
    states_before = (PAUSED,)
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.resume(agent_id)


class SwitchOff(Fault):
    """These agents are switched off for the rest of the run. Each exports its chain and ends (Section 4.2)."""

    what = "switch_off"
    states_before = (RUNNING,)
    state_after = SWITCHED_OFF
    ends_incarnation = True
    removes_vehicle = True
    exports_chain = True
    mark = SQUARE
    meaning = "switched off"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.switch_off(agent_id)
