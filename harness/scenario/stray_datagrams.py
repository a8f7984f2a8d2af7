"""Datagrams on the air that no agent of the scenario sends: from a vehicle of which nothing but these was heard.

datagrams:
  - {source: 32, datagram: VUMBBQ..., reaches: {10: 812.3, 28: 812.31}}
"""

from typing import Annotated

from pydantic import Field

from harness.scenario.strict_model import Data, Instant, Model, VehicleId, VehicleKey

MAX_CHARACTERS = 4 * (65536 // 3 + 1)
"""What the largest datagram that UDP has is in base64."""


class ScriptedDatagram(Model):
    """`datagram`, in base64, under the address of vehicle `source`, `reaches` these agents at these mission seconds.

    Nothing else becomes of it: no loss, no partition.
    """

    source: VehicleId
    datagram: Annotated[Data, Field(max_length=MAX_CHARACTERS)]
    reaches: Annotated[dict[VehicleKey, Instant], Field(min_length=1)]
