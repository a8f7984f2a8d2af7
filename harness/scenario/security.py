"""Keys of a mission, in a scenario."""

from typing import Annotated

from pydantic import Field

from harness.scenario.strict_model import Model, VehicleId


class Security(Model):
    """The mission is secured: datagrams are authentic, confidential and fresh, blocks signed by their makers."""

    keys: Annotated[str, Field(min_length=1, max_length=4000)] = "fresh"
    """`fresh`: each run has keys of its own. Else the directory that `ucp-harness keys new` made, or one of bundles."""
    captured: VehicleId | None = None
    """The vehicle whose keys the rogue node has: what it injects is sealed with them."""
    seal: bool = False
    """Event data is sealed to the depot, too: whoever carries it cannot read it. Blocks have 48 bytes less of it."""
