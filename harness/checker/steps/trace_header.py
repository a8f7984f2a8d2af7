"""Check the header of a trace, and read the agent's mission from it."""

import base64
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from harness.archive.traces import TraceHeader
from harness.checker._waiting import SLACK_WALL_S
from harness.checker.reference.state import Settings as ReferenceSettings
from ucp.block import MAX_AGENT_ID
from ucp.settings import Settings

EARLY_WALL_S = 0.001
"""Seconds of wall time by which a timer may expire early, because an agent reads its clock more than once."""
ROUNDING_S = 2e-3
"""Rounding error in seconds of times in a trace, which may be rounded to milliseconds."""

_SETTINGS = {setting.name for setting in fields(Settings)}


class ImpossibleHeaderError(Exception):
    """An error: the header contains settings or a clock that no agent can have. The message is one sentence."""


class UnknownSettingError(ImpossibleHeaderError):
    """An error: the agent uses a setting that the reference does not implement, so its steps cannot be judged."""


@dataclass(frozen=True)
class CheckedHeader:
    """The mission that a trace header describes. A timer may expire up to `early_s` mission seconds early and `late_s`
    mission seconds late.
    """

    agent_id: int
    roster: frozenset[int]
    initial_data: bytes
    settings: Settings
    offset_s: float
    rate: float
    early_s: float
    late_s: float
    secured: bool = False
    seal: Callable[[bytes, int], bytes] | None = field(default=None, repr=False, compare=False)
    """A function that returns the encrypted event data as far as the agent recorded it. None if the mission does not
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
        given = {**asdict(ReferenceSettings()), **header.settings}  # the defaults of an edited core may be wrong
        settings = Settings(**{name: value for name, value in given.items() if name in _SETTINGS})
    except (ValueError, TypeError) as error:
        raise ImpossibleHeaderError(f"the header of its trace has invalid settings: {str(error)[:200]}") from None
    if unknown := _unknown_to_reference(settings):
        raise UnknownSettingError(f"the settings include {', '.join(unknown)}, which the reference lacks")
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


def _unknown_to_reference(settings: Settings) -> list[str]:
    """Return the settings that the reference does not implement and that differ from their default values."""
    lacking = _SETTINGS - {setting.name for setting in fields(ReferenceSettings)}
    usual = Settings()
    return sorted(name for name in lacking if getattr(settings, name) != getattr(usual, name))


def _clock(header: TraceHeader, key: str, default: float) -> float:
    value: Any = header.clock.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ImpossibleHeaderError(f"the header of its trace has an invalid clock: {key} {str(value)[:20]}")
    return float(value)
