"""Another vehicle in the place of a lost one, with an agent that has nothing yet."""

from harness.scenario.faults.fault import ARROW, KILLED, Fault, Lives


class Restart(Fault):
    """Killed agents begin anew, on vehicles at their homes, with nothing but the inception block."""

    what = "restart"
    needs = (KILLED,)
    begins_a_life = True
    brings_a_vehicle = True
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.begin_life(agent_id, new_vehicle=True)
