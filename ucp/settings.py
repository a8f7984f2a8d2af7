"""What an agent can be told: timers, sizes, and the readings of an ambiguous thesis."""

from dataclasses import dataclass
from typing import Literal, get_args

from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MAX_EVENT_BYTES

Phase1Tie = Literal["phase2", "pop"]
Phase2Tie = Literal["oldest", "block"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Durations in mission seconds, sizes in bytes. Raises ValueError for impossible values."""

    vote_timeout_s: float = 10.0
    phase1_timeout_s: float = 5.0
    phase2_timeout_s: float = 5.0
    phase3_timeout_s: float = 5.0
    finalize_gap_s: float = 0.1
    """Pause between the commits of Algorithm 20, so that others can follow (Section 4.2)."""

    max_block_bytes: int = MAX_EVENT_DATA_BYTES
    max_event_bytes: int = MAX_EVENT_BYTES

    vote_names_chain: bool = False
    """A vote also names the proposer's chain, so that a late vote of an earlier round cannot count."""
    changed_before_tally: bool = False
    """Algorithm 5 looks for a changed chain before it tallies, instead of after."""
    phase1_tie: Phase1Tie = "phase2"
    """Algorithm 11 on a tie: go on to phase 2 as printed, or pop another block."""
    phase2_tie: Phase2Tie = "oldest"
    """Algorithm 15 on a tie: the oldest timestamp, or never "Is Top Of Chain" while a block is on offer."""

    def __post_init__(self) -> None:
        for name in ("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be more than 0 seconds, not {getattr(self, name)}")
        if not 0 <= self.finalize_gap_s < float("inf"):
            raise ValueError(f"finalize_gap_s must not be negative, not {self.finalize_gap_s}")
        if not 0 < self.max_block_bytes <= MAX_EVENT_DATA_BYTES:
            raise ValueError(f"max_block_bytes must be 1..{MAX_EVENT_DATA_BYTES}, not {self.max_block_bytes}")
        if not 0 < self.max_event_bytes <= self.max_block_bytes:
            raise ValueError(f"max_event_bytes must be 1..max_block_bytes, not {self.max_event_bytes}")
        for name, allowed in (("phase1_tie", get_args(Phase1Tie)), ("phase2_tie", get_args(Phase2Tie))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {getattr(self, name)!r}")
