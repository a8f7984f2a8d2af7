"""An agent that was paused goes on."""

from harness.scenario.faults.fault import ARROW, PAUSED, Fault, Lives


class Resume(Fault):
    """Paused agents go on, with what has waited for them."""

    what = "resume"
    needs = (PAUSED,)
    mark = ARROW
    meaning = "goes on, or begins anew"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.resume(agent_id)
