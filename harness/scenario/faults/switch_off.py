"""A vehicle is switched off, whatever its agent was about to do; what it holds is kept, and brought home."""

from harness.scenario.faults.fault import RUNNING, SQUARE, SWITCHED_OFF, Fault, Lives


class SwitchOff(Fault):
    """They are switched off for good: each exports its chain, as it is then, and ends (Section 4.2)."""

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
