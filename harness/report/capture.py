"""Whether the captures of a run are whole."""

from typing import Any

from harness.archive.result import agent_ids, mapping, number
from harness.report.chain_tree import ranges


def gaps(result: dict[str, Any]) -> str | None:
    """A sentence of what the captures lack, if they lack anything."""
    captured = mapping(result, "capture")
    dropped = {vehicle: number(captured, vehicle, "dropped") or 0 for vehicle in captured}
    lacking = agent_ids(vehicle for vehicle, frames in dropped.items() if frames)
    if not lacking:
        return None
    frames = sum(dropped.values())
    received = sum(number(captured, vehicle, "received") or 0 for vehicle in captured)
    whose = f"vehicle{'s' if len(lacking) > 1 else ''} {', '.join(ranges(lacking))}"
    return f"the capture lacks {frames:.0f} of {received:.0f} frames, of {whose}: this machine was too slow to keep up"
