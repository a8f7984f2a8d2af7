"""Faults of agents and vehicles, with a class for each kind of fault. This package finds the classes in its modules.

No other module lists the faults: to add one, add its class to a file in this directory.
"""

from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from harness.scenario.faults.fault import AgentIds, AgentOperations, DiskState, Fault
from harness.scenario.faults.vehicle_fault import VehicleFault

__all__ = [
    "KINDS",
    "TIMELINE_FAULTS",
    "AgentIds",
    "AgentOperations",
    "DiskState",
    "Fault",
    "VehicleFault",
    "fault_class",
]

for file in iter_modules(__path__):
    import_module(f"{__name__}.{file.name}")


def _below(kind: type[Fault]) -> Iterator[type[Fault]]:
    """Yield the subclasses that are faults with a name, in the order of their definition."""
    for derived in kind.__subclasses__():
        if derived.what:
            yield derived
        yield from _below(derived)


KINDS: tuple[type[Fault], ...] = tuple(_below(Fault))
TIMELINE_FAULTS: tuple[type[Fault], ...] = tuple(kind for kind in KINDS if kind.is_timeline_key)
"""Faults that are keys of a timeline entry."""

_BY_NAME = {kind.what: kind for kind in KINDS}


def fault_class(what: str) -> type[Fault]:
    """Return the class of the fault with this name. For an unknown name, return the class `Fault`, which does
    nothing.
    """
    return _BY_NAME.get(what, Fault)
