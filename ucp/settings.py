"""What an agent can be told: timers, sizes, and the readings of an ambiguous thesis."""

import math
from typing import Any, Literal, get_args

from ucp._dataclass import dataclass
from ucp.block import MAX_EVENT_DATA_BYTES
from ucp.events import MAX_EVENT_BYTES
from ucp.short_value import shown

MAX_TIMER_S = 1e9
"""Thirty years."""

ADDED = ("asks_after_commit", "top_needs_majority")
"""Settings that the first agents of contract 2 do not have."""

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
    asks_after_commit: bool = False
    """Algorithm 5 asks, a finalize gap after its commit, who does not follow: who has diverged then reconciles."""
    top_needs_majority: bool = False
    """Algorithm 15 ends the search only where a vote would be approved: more than half have this very chain."""
    phase1_tie: Phase1Tie = "phase2"
    """Algorithm 11 on a tie: go on to phase 2 as printed, or pop another block."""
    phase2_tie: Phase2Tie = "oldest"
    """Algorithm 15 on a tie: the oldest timestamp, or never "Is Top Of Chain" while a block is on offer."""

    def __post_init__(self) -> None:
        for name in ("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s"):
            self._check(name, f"more than 0 seconds, at most {MAX_TIMER_S:g}", (int, float), math.ulp(0.0), MAX_TIMER_S)
        self._check("finalize_gap_s", f"0..{MAX_TIMER_S:g} seconds", (int, float), 0, MAX_TIMER_S)
        self._check("max_block_bytes", f"1..{MAX_EVENT_DATA_BYTES}", (int,), 1, MAX_EVENT_DATA_BYTES)
        self._check("max_event_bytes", "1..max_block_bytes", (int,), 1, self.max_block_bytes)
        for name in ("vote_names_chain", "changed_before_tally", "asks_after_commit", "top_needs_majority"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be true or false, not {shown(getattr(self, name))}")
        for name, allowed in (("phase1_tie", get_args(Phase1Tie)), ("phase2_tie", get_args(Phase2Tie))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {shown(getattr(self, name))}")

    def told(self) -> dict[str, Any]:
        """As missions and traces say them: what the contract once did not have is left out where it is as by default.

        So an agent that knows nothing of it can play a mission that does not need it.
        """
        usual = Settings()
        told = {name: getattr(self, name) for name in self.__match_args__}
        return {name: value for name, value in told.items() if name not in ADDED or value != getattr(usual, name)}

    def _check(self, name: str, allowed: str, kinds: tuple[type, ...], low: float, high: float) -> None:
        value = getattr(self, name)
        if type(value) not in kinds or not low <= value <= high:
            raise ValueError(f"{name} must be {allowed}, not {shown(value)}")
