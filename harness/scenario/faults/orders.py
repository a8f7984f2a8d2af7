"""Orders from the ground: reconcile, revoke keys, stop logging events."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from harness.scenario.faults.fault import BAR, KILLED, PAUSED, REBOOTING, RUNNING, SWITCHED_OFF, Fault, Lives
from harness.scenario.strict_model import VehicleId


class Reconcile(Fault):
    """These agents start a reconcile, as an operator can request (Section 5.1). No effect during a reconcile."""

    what = "reconcile"
    needs = (RUNNING,)

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.reconcile(agent_id)


Hearers = Annotated[list[VehicleId], Field(min_length=1)]


@dataclass(frozen=True)
class Revoke(Fault):
    """The authority revokes the keys of these agents. Only secured missions have keys."""

    heard_by: Hearers

    key_descriptions = {
        "heard_by": "IDs of the vehicles that receive the message of `revoke` from the ground. They forward it."
    }
    what = "revoke"
    needs = (RUNNING, PAUSED, KILLED, REBOOTING, SWITCHED_OFF)
    leads_to = None
    needs_keys = True
    keys_in_words = "`heard_by`, the vehicles in reach of the ground"
    mark = "M-6 0h12m-9-5l6 10m0-10l-6 10"
    meaning = "keys revoked"

    @property
    def also_named(self) -> list[int]:
        return self.heard_by

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.revoke(agent_id, self.heard_by)


class StopEvents(Fault):
    """These agents log no further events, as a vehicle on the ground (Section 4.2). Votes and reconciles continue."""

    what = "stop_events"
    needs = (RUNNING,)
    stops_events = True
    mark = BAR
    meaning = "logs no more events"

    async def strike(self, lives: Lives, agent_id: int) -> None:
        await lives.stop_logging(agent_id)
