"""Deliberate errors (quirks) that an agent makes on request. They show which checks detect which errors.

A quirk replaces a handler, or a helper that handlers use. An agent has quirks only if its mission, its scenario or the
command `quirk` names them. Some quirks repeat mistakes from the thesis: `ignore_commit` (Section 4.2), and
`crash_on_tie`, `early_phase3_expiry`, `stale_chain_hash`, `break_off_commit` and `wrong_topic` from its tests (Sections
4.2 and 4.3).
"""

from collections.abc import Mapping
from difflib import get_close_matches
from random import Random
from typing import Any

from ucp.agent import HANDLERS
from ucp.handler import EventHandler
from ucp.quirks import _commit_quirks, _core_quirks, _reconcile_quirks
from ucp.quirks._quirk import CRASHED, Quirk, catch_exceptions

__all__ = [
    "CRASHED",
    "QUIRKS",
    "Quirk",
    "Quirks",
    "UnknownQuirkError",
    "active_quirks",
    "check_quirk",
    "wrong_handlers",
]

Quirks = dict[str, bool | float]
"""Quirks of an agent. The value of a quirk is true or a probability. False and 0 mean the same as a missing quirk."""

QUIRKS: dict[str, Quirk] = {
    quirk.name: quirk
    for module in (_commit_quirks, _reconcile_quirks, _core_quirks)
    for quirk in vars(module).values()
    if isinstance(quirk, Quirk)
}
"""All quirks by name, in the order of their Algorithms."""

MAX_NAME = 40
"""Maximum number of characters of an unknown name in an error message."""


class UnknownQuirkError(ValueError):
    """An error: no deliberate error has this name."""


def check_quirk(name: str, value: object) -> None:
    """Raise UnknownQuirkError if no deliberate error has this name, and ValueError if it cannot have this value."""
    if name not in QUIRKS:
        name = name[:MAX_NAME]
        near = ", ".join(get_close_matches(name, QUIRKS, cutoff=0.0))
        raise UnknownQuirkError(f"unknown quirk {name!r}: of the {len(QUIRKS)} in ucp/quirks the nearest are {near}")
    QUIRKS[name].check(value)


def active_quirks(quirks: Mapping[str, bool | float]) -> dict[str, float]:
    """Return the quirks that are switched on: the quirks whose value is neither false nor 0."""
    return {name: float(quirks[name]) for name in QUIRKS if quirks.get(name)} if quirks else {}


def wrong_handlers(quirks: Mapping[str, bool | float], rng: Random) -> list[EventHandler[Any]]:
    """Return the wrong handlers of an agent with these quirks. The result is empty if no quirk is switched on.

    The handlers draw random numbers from `rng`.
    """
    wrong = active_quirks(quirks)
    if not wrong:
        return []
    handlers = {handler.algorithm: handler for handler in HANDLERS.values()}
    for name, value in wrong.items():
        for algorithm in QUIRKS[name].algorithms:
            handlers[algorithm] = QUIRKS[name].wrong_handler(handlers[algorithm], value, rng)
    return [catch_exceptions(handler) for handler in handlers.values()]
