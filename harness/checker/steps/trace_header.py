"""Check the header of a trace, and read the agent's mission from it."""

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

from harness.archive.traces import TraceHeader
from harness.checker._waiting import SLACK_WALL_S
from harness.checker.reference.state import Settings
from ucp.block import MAX_AGENT_ID, MAX_EVENT_DATA_BYTES

EARLY_WALL_S = 0.001
"""Tolerance for early expiries of timers, in seconds of wall time. A timer may seem to expire early, because the agent
may read its clock when it starts the timer, and again for the trace line.
"""
ROUNDING_S = 2e-3
"""Rounding error in seconds of times in a trace, which may be rounded to milliseconds."""

MAX_TIMER_S = 1e9
"""Maximum duration of a timer in seconds."""


class ImpossibleHeaderError(Exception):
    """An error: the header contains settings or a clock that no agent can have. The message is one sentence."""


class UnknownSettingError(ImpossibleHeaderError):
    """An error: the agent uses a setting that the reference does not implement, so its steps cannot be judged."""


@dataclass(frozen=True)
class CheckedHeader:
    """The facts about a mission and an agent's clock that the agent wrote into the header of its trace."""

    agent_id: int
    roster: frozenset[int]
    initial_data: bytes
    settings: Settings
    offset_s: float
    rate: float
    early_s: float
    """Maximum number of mission seconds by which a timer may expire early."""
    late_s: float
    """Maximum number of mission seconds by which a timer may expire late."""
    secured: bool = False
    seal: Callable[[bytes, int], bytes] | None = field(default=None, repr=False, compare=False)
    """A function that returns the encrypted event data, if the agent recorded them. None if the mission does not
    encrypt event data.
    """

    def local(self, mission_s: float) -> float:
        """Return the time that the agent's clock shows at this mission second."""
        return self.offset_s + self.rate * mission_s


def checked(header: TraceHeader) -> CheckedHeader:
    """Check a trace header. Return the mission that it describes. Raises ImpossibleHeaderError if its values are
    invalid.
    """
    try:
        initial_data = base64.b64decode(header.initial_data or "", validate=True)
    except ValueError as error:
        raise ImpossibleHeaderError(f"the header of its trace has invalid data: {str(error)[:200]}") from None
    settings = _settings(header)
    if not 1 <= header.agent_id <= MAX_AGENT_ID:
        raise ImpossibleHeaderError(f"the header of its trace has an invalid agent ID: {str(header.agent_id)[:20]}")
    speedup, drift = _clock(header, "speedup", 1.0), _clock(header, "drift", 0.0)
    if speedup <= 0 or drift <= -1:
        raise ImpossibleHeaderError("the header of its trace has an invalid clock")
    return CheckedHeader(
        header.agent_id,
        frozenset(header.roster),
        initial_data,
        settings,
        _clock(header, "offset_s", 0.0),
        1 + drift,
        EARLY_WALL_S * speedup + ROUNDING_S,
        SLACK_WALL_S * speedup,
        bool(header.secured),
    )


def _settings(header: TraceHeader) -> Settings:
    """Return the settings in the header. For a missing setting, the reference's own default applies. The default of the
    agent core is not used, because an edited core may have a wrong default.
    """
    known = {setting.name: setting.default for setting in fields(Settings)}
    if unknown := sorted(str(name)[:40] for name in header.settings.keys() - known.keys()):
        raise UnknownSettingError(f"the settings include {', '.join(unknown[:3])}, which the reference lacks")
    for name, value in header.settings.items():
        allowed = (int, float) if isinstance(known[name], float) else (type(known[name]),)
        if type(value) not in allowed:
            raise _invalid(name, value)
    settings = Settings(**header.settings)
    timeouts = ("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s")
    shortest = min(getattr(settings, name) for name in timeouts)
    possible = {name: 0 < getattr(settings, name) <= MAX_TIMER_S for name in timeouts} | {
        "finalize_gap_s": 0 <= settings.finalize_gap_s <= MAX_TIMER_S,
        "max_block_bytes": 1 <= settings.max_block_bytes <= MAX_EVENT_DATA_BYTES,
        "max_event_bytes": 1 <= settings.max_event_bytes <= settings.max_block_bytes,
        "phase1_tie": settings.phase1_tie in ("phase2", "pop"),
        "phase2_tie": settings.phase2_tie in ("oldest", "block"),
        "answer_spread_s": settings.answer_spread_s == 0 or 0 < settings.answer_spread_s < shortest,
    }
    for name, is_possible in possible.items():
        if not is_possible:
            raise _invalid(name, getattr(settings, name))
    return settings


def _invalid(name: str, value: object) -> ImpossibleHeaderError:
    return ImpossibleHeaderError(f"the header of its trace has invalid settings: {name} is {str(value)[:40]!r}")


def _clock(header: TraceHeader, key: str, default: float) -> float:
    value: Any = header.clock.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ImpossibleHeaderError(f"the header of its trace has an invalid clock: {key} {str(value)[:20]}")
    return float(value)
