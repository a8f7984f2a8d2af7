"""The operator asks agents to reconcile."""

from harness.scenario.faults.fault import RUNNING, Fault, Lives


class Reconcile(Fault):
    """They begin a reconcile, as the operator asks (Section 5.1); one that reconciles already goes on with that."""

    what = "reconcile"
    needs = (RUNNING,)

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.reconcile(agent_id)
