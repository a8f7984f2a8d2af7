"""What an input makes of an agent."""

from typing import NamedTuple

Started = tuple[tuple[int, int], ...]
"""Timers that an agent has started in this instant and that run: (number, duration in microseconds)."""


class Step(NamedTuple):
    """What an input makes of an agent: its state, the messages that it sends, the timers that it has started."""

    local: int
    sent: tuple[int, ...]
    started: Started


class End(NamedTuple):
    """What may come of it when a timer ends, and which of the candidates of phase 2 is the oldest then."""

    step: Step
    oldest: bytes | None
