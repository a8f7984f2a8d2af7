"""The vehicle falls to the ground, and its agent is destroyed."""

from harness.scenario.faults.fault import CROSS, KILLED, PAUSED, RUNNING, Fault, Lives
from harness.scenario.vehicles import Vehicles


class Crash(Fault):
    """Their vehicles fall to the ground; they are gone as by `kill`."""

    what = "crash"
    needs = (RUNNING, PAUSED)
    leads_to = KILLED
    ends_a_life = True
    takes_the_vehicle = True
    mark = CROSS
    meaning = "lost"

    def check(self, vehicles: Vehicles) -> None:
        if vehicles.kind == "none":
            raise ValueError("needs vehicles that can fall: `vehicles.kind` is none, where `kill` does the same")

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.fall(agent_id)
        await lives.end_life(agent_id)
