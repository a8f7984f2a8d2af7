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
    Disk,
    Fault,
    Lives,
)
from harness.scenario.strict_model import Seconds
from harness.scenario.vehicles import Vehicles


class Crash(Fault):
    """The vehicles of these agents fall to the ground. The agents end as with `kill`."""

    what = "crash"
    needs = (RUNNING, PAUSED)
    leads_to = KILLED
    ends_a_life = True
    takes_the_vehicle = True
    mark = CROSS
    meaning = "lost"

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles that can fall, but `vehicles.kind` is none: use `kill` instead")

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.fall(agent_id)
        await lives.end_life(agent_id)


class Kill(Fault):
    """These agents end, with their vehicles and all their data (Section 3.3)."""

    what = "kill"
    needs = (RUNNING, PAUSED)
    leads_to = KILLED
    ends_a_life = True
    takes_the_vehicle = True
    mark = CROSS
    meaning = "lost"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.end_life(agent_id, with_vehicle=True)


class Pause(Fault):
    """These agents stop. Their incoming messages wait until `resume`."""

    what = "pause"
    needs = (RUNNING,)
    leads_to = PAUSED
    stands_still = True
    mark = BARS
    meaning = "paused"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.pause(agent_id)


@dataclass(frozen=True)
class Reboot(Fault):
    """The computers of these agents fail, and start again after `down_s`, with or without the data on their disks."""

    down_s: Seconds
    disk: Disk

    key_descriptions = {
        "down_s": "Mission seconds until the agents of `reboot` start again.",
        "disk": "Whether the agents of `reboot` start with the data on their disks, or with the inception block only.",
    }
    what = "reboot"
    needs = (RUNNING, PAUSED)
    leads_to = REBOOTING
    ends_a_life = True
    unless_told = {"down_s": 30.0, "disk": "kept"}
    keys_in_words = "`down_s`, in mission seconds, and `disk: kept` or `disk: lost`"
    mark = DIAMOND
    meaning = "reboots"

    @property
    def disk_left(self) -> Disk:
        return self.disk

    def course(self) -> Sequence[Fault]:
        return [self, Boot(self.at_s + self.down_s, self.agents, self.disk)]

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.end_life(agent_id, disk_kept=self.disk == "kept")


@dataclass(frozen=True)
class Boot(Fault):
    """The end of a reboot."""

    disk: Disk

    what = "boot"
    is_asked_for = False
    needs = (REBOOTING,)
    begins_a_life = True
    mark = ARROW
    meaning = "goes on, or begins anew"

    @property
    def disk_left(self) -> Disk:
        return self.disk

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.begin_life(agent_id)


class Restart(Fault):
    """These killed agents start again, on new vehicles at their homes, with the inception block only."""

    what = "restart"
    needs = (KILLED,)
    begins_a_life = True
    brings_a_vehicle = True
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.begin_life(agent_id, new_vehicle=True)


class Resume(Fault):
    """These paused agents continue, and receive the messages that waited for them."""

    what = "resume"
    needs = (PAUSED,)
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.resume(agent_id)


class SwitchOff(Fault):
    """These agents are switched off for the rest of the run. Each exports its chain and ends (Section 4.2)."""

    what = "switch_off"
    needs = (RUNNING,)
    leads_to = SWITCHED_OFF
    ends_a_life = True
    takes_the_vehicle = True
    leaves_an_export = True
    mark = SQUARE
    meaning = "switched off"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.switch_off(agent_id)
