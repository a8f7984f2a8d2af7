"""The air of a scenario: what happens to messages on the way to each receiver."""

from harness.scenario.model import Model, Probability, VehicleId
from netem.conditions import LinkConditions, NetworkConditions


class Receiver(Model):
    """What one vehicle hears: loss of every message sent to it, independently per message."""

    loss: Probability


class NetworkModel(Model):
    """Loss for every receiver, and receivers that differ."""

    loss: Probability = 0.0
    receivers: dict[VehicleId, Receiver] = {}

    def conditions(self, partition: tuple[frozenset[int], ...] = ()) -> NetworkConditions:
        return NetworkConditions(
            LinkConditions(loss=self.loss),
            {vehicle: LinkConditions(loss=receiver.loss) for vehicle, receiver in self.receivers.items()},
            partition,
        )
