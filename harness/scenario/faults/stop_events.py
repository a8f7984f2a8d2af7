"""A vehicle has landed: it logs nothing more, and takes part as before."""

from harness.scenario.faults.fault import BAR, RUNNING, Fault, Lives


class StopEvents(Fault):
    """They log no more events, as a vehicle on the ground does (Section 4.2); votes and reconciles go on."""

    what = "stop_events"
    needs = (RUNNING,)
    stops_events = True
    mark = BAR
    meaning = "logs no more events"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.stop_logging(agent_id)
