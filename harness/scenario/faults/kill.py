"""Shot down: agent and vehicle are gone at once."""

from harness.scenario.faults.fault import CROSS, KILLED, PAUSED, RUNNING, Fault, Lives


class Kill(Fault):
    """They are gone with their vehicles, and all that they held with them (Section 3.3)."""

    what = "kill"
    needs = (RUNNING, PAUSED)
    leads_to = KILLED
    ends_a_life = True
    takes_the_vehicle = True
    mark = CROSS
    meaning = "lost"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.end_life(agent_id, with_vehicle=True)
