"""The mission of an agent under test: a file of which all that matters is in it."""

import base64
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from harness.conformance.reference_model import AGENT, INITIAL_DATA, ROSTER
from harness.conformance.state_space import Variant
from harness.play.process.agent_mission import NO_QUIRKS
from ucp.features import CONTRACT
from ucp.mission import SCHEMA

NO_KEYS: Mapping[str, Any] = MappingProxyType({})


def mission(
    variant: Variant, *, address: str, broadcast: str, port: int, speedup: float, keys: Mapping[str, Any] = NO_KEYS
) -> dict[str, Any]:
    """`keys` take the place of those that are here."""
    return {
        "schema": SCHEMA,
        "contract": CONTRACT,
        "features": list(variant.features),
        "agent_id": AGENT,
        "roster": list(ROSTER),
        "initial_data": base64.b64encode(INITIAL_DATA).decode("ascii"),
        "network": {"address": address, "broadcast": broadcast, "port": port},
        "events": {
            "source": "none",
            "mean_s": 30.0,
            "position_interval_s": 10.0,
            "log": ["mode", "arming", "text", "position"],
            "vehicle_host": "127.0.0.1",
            "vehicle_port": 5762,
        },
        "settings": variant.settings.told(),
        "quirks": dict(NO_QUIRKS),
        "seed": 1,
        "speedup": speedup,
        "epoch_us": None,
        "store": None,
        **keys,
    }
