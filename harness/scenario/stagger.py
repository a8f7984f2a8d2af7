"""Timers that run longer from agent to agent, so that agents which did the same at once do not go on at once.

The mission says so: each agent is given settings of its own, and knows nothing of it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from ucp.settings import MAX_TIMER_S, Settings

Staggered = Literal["vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s"]
Stagger = dict[Staggered, Annotated[float, Field(ge=0, le=MAX_TIMER_S)]]
"""By how many mission seconds a timer of each agent runs longer than that of the agent before it on the roster."""


def staggered(settings: Settings, stagger: Mapping[Staggered, float], place: int) -> Settings:
    """The settings of the agent at `place` of the roster, from 0. Raises ValueError if a timer gets too long."""
    longer = {name: getattr(settings, name) + step_s * place for name, step_s in stagger.items() if step_s}
    return dataclasses.replace(settings, **longer) if longer else settings
