"""An agent stands still, as a process that is stopped does."""

from harness.scenario.faults.fault import BARS, PAUSED, RUNNING, Fault, Lives


class Pause(Fault):
    """They stand still, and what reaches them waits until `resume`."""

    what = "pause"
    needs = (RUNNING,)
    leads_to = PAUSED
    stands_still = True
    mark = BARS
    meaning = "paused"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.pause(agent_id)
