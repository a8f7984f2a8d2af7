"""Whether the captures of a run are whole."""

from collections.abc import Mapping

from harness.archive.run_record import CapturedFrames
from harness.report.chain_tree import ranges


def gaps(captured: Mapping[str, CapturedFrames]) -> str | None:
    """A sentence of what the captures of these vehicles lack, if they lack anything."""
    lacking = sorted(int(vehicle) for vehicle, frames in captured.items() if frames.dropped)
    if not lacking:
        return None
    dropped = sum(frames.dropped for frames in captured.values())
    received = sum(frames.received for frames in captured.values())
    whose = f"vehicle{'s' if len(lacking) > 1 else ''} {', '.join(ranges(lacking))}"
    return f"the capture lacks {dropped} of {received} frames, of {whose}: this machine was too slow to keep up"
