"""Commands from the ground to agents: reconcile, revoke a vehicle, or stop logging events."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from harness.scenario.faults.fault import BAR, KILLED, PAUSED, REBOOTING, RUNNING, SWITCHED_OFF, AgentOperations, Fault
from harness.scenario.strict_model import VehicleId


class Reconcile(Fault):
    """These agents start a reconcile, as an operator can request (Section 5.1). The command has no effect on an agent
    that is already in a reconcile.
    """

    what = "reconcile"
    states_before = (RUNNING,)

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.reconcile(agent_id)


Receivers = Annotated[list[VehicleId], Field(min_length=1)]


@dataclass(frozen=True)
class Revoke(Fault):
    """The authority revokes the keys of these agents. Only secured missions have keys."""

    heard_by: Receivers

    key_descriptions = {
        "heard_by": "IDs of the vehicles that receive the message of `revoke` from the ground. They forward it."
    }
    what = "revoke"
    states_before = (RUNNING, PAUSED, KILLED, REBOOTING, SWITCHED_OFF)
    state_after = None
    needs_keys = True
    keys_in_words = "`heard_by`, the vehicles in reach of the ground"
    mark = "M-6 0h12m-9-5l6 10m0-10l-6 10"
    meaning = "keys revoked"

    @property
    def further_vehicles(self) -> list[int]:
        return self.heard_by

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.revoke(agent_id, self.heard_by)


class StopEvents(Fault):
    """These agents log no further events, like the agents of vehicles on the ground (Section 4.2). Votes and reconciles
    continue.
    """

    what = "stop_events"
    states_before = (RUNNING,)
    stops_events = True
    mark = BAR
    meaning = "logs no more events"

    async def apply(self, operations: AgentOperations, agent_id: int) -> None:
        await operations.stop_logging(agent_id)
