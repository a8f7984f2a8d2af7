"""What can happen to agents: a file for each fault, and no list of them anywhere else."""

from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from harness.scenario.faults.fault import Agents, Disk, Fault, Lives
from harness.scenario.faults.vehicle_fault import VehicleFault

__all__ = ["ASKED_FOR", "KINDS", "Agents", "Disk", "Fault", "Lives", "VehicleFault", "named"]

for file in iter_modules(__path__):
    import_module(f"{__name__}.{file.name}")


def _below(kind: type[Fault]) -> Iterator[type[Fault]]:
    """Those that have a word, in the order in which they were read."""
    for derived in kind.__subclasses__():
        if derived.what:
            yield derived
        yield from _below(derived)


KINDS: tuple[type[Fault], ...] = tuple(_below(Fault))
ASKED_FOR: tuple[type[Fault], ...] = tuple(kind for kind in KINDS if kind.is_asked_for)
"""Those that are keys of a timeline entry."""

_BY_NAME = {kind.what: kind for kind in KINDS}


def named(what: str) -> type[Fault]:
    """What the word of a record stands for; Fault itself, which does nothing, if it is no fault that is known."""
    return _BY_NAME.get(what, Fault)
