"""A computer browns out and is back some time later, while its vehicle flies on."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.scenario.faults.fault import ARROW, DIAMOND, PAUSED, REBOOTING, RUNNING, Disk, Fault, Lives
from harness.scenario.strict_model import Seconds


@dataclass(frozen=True)
class Reboot(Fault):
    """Their computers brown out; they are back after `down_s` with what was on their disks, or with nothing."""

    down_s: Seconds
    disk: Disk

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
