"""Wrong agents: mistakes that an agent makes on request, so that tests show what finds them.

A quirk replaces a handler, or a helper that handlers use. An agent has quirks only if its mission, its scenario or the
command `quirk` names them. The thesis's own mistakes are among them: `ignore_commit` (Section 4.2), and `crash_on_tie`,
`early_phase3_expiry`, `stale_chain_hash`, `break_off_commit` and `wrong_topic` from its tests (Sections 4.2 and 4.3).
"""

from collections.abc import Mapping
from difflib import get_close_matches
from random import Random
from typing import Any

from ucp.agent import HANDLERS
from ucp.handler import EventHandler
from ucp.quirks import _commit_quirks, _core_quirks, _reconcile_quirks
from ucp.quirks._quirk import CRASHED, Quirk, ending_by_exceptions

__all__ = ["CRASHED", "QUIRKS", "Quirk", "Quirks", "UnknownQuirkError", "check_quirk", "in_force", "wrong_handlers"]

Quirks = dict[str, bool | float]
"""Quirk -> true, or its probability. False, 0 and a quirk that is left out are the same."""

QUIRKS: dict[str, Quirk] = {
    quirk.name: quirk
    for module in (_commit_quirks, _reconcile_quirks, _core_quirks)
    for quirk in vars(module).values()
    if isinstance(quirk, Quirk)
}
"""All quirks by name, in the order of their Algorithms."""

MAX_NAME = 40
"""More of a wrong name is not shown."""


class UnknownQuirkError(ValueError):
    """The name of a quirk is unknown."""


def check_quirk(name: str, value: object) -> None:
    """Raises ValueError for a value that is not allowed, and UnknownQuirkError for an unknown name."""
    if name not in QUIRKS:
        name = name[:MAX_NAME]
        near = ", ".join(get_close_matches(name, QUIRKS, cutoff=0.0))
        raise UnknownQuirkError(f"unknown quirk {name!r}: of the {len(QUIRKS)} in ucp/quirks the nearest are {near}")
    QUIRKS[name].check(value)


def in_force(quirks: Mapping[str, bool | float]) -> dict[str, float]:
    """The quirks that are neither false nor 0; with none the agent is a right one."""
    return {name: float(quirks[name]) for name in QUIRKS if quirks.get(name)} if quirks else {}


def wrong_handlers(quirks: Mapping[str, bool | float], lots: Random) -> list[EventHandler[Any]]:
    """The handlers of an agent with these quirks; none if no quirk is in force.

    They draw random numbers from `lots`.
    """
    wrong = in_force(quirks)
    if not wrong:
        return []
    handlers = {handler.algorithm: handler for handler in HANDLERS.values()}
    for name, value in wrong.items():
        for algorithm in QUIRKS[name].algorithms:
            handlers[algorithm] = QUIRKS[name].in_place_of(handlers[algorithm], value, lots)
    return [ending_by_exceptions(handler) for handler in handlers.values()]
