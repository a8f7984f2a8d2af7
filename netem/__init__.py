"""Control the packets between vehicles: network conditions, a virtual network, and the kernel mechanisms that apply the
conditions.

`__all__` lists the public names. The first process of every lab imports this package. To let this process start faster,
Python imports a public name only when a program first uses the name.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from netem.conditions import NetworkConditions
    from netem.errors import ConditionsError, LabUnavailable, NetemError
    from netem.lab import Lab
    from netem.link import Delay, GilbertElliott, LinkConditions
    from netem.medium import Medium
    from netem.radio import HardRange, LogDistance, Place

__all__ = [
    "ConditionsError",
    "Delay",
    "GilbertElliott",
    "HardRange",
    "Lab",
    "LabUnavailable",
    "LinkConditions",
    "LogDistance",
    "Medium",
    "NetemError",
    "NetworkConditions",
    "Place",
]

_NAMES_OF = {
    "netem.conditions": ("NetworkConditions",),
    "netem.errors": ("ConditionsError", "LabUnavailable", "NetemError"),
    "netem.lab": ("Lab",),
    "netem.link": ("Delay", "GilbertElliott", "LinkConditions"),
    "netem.medium": ("Medium",),
    "netem.radio": ("HardRange", "LogDistance", "Place"),
}
"""Module -> its public names. Python imports the module when a program first uses one of these names."""
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        return getattr(import_module(_MODULE_OF[name]), name)

    def __dir__() -> list[str]:
        return __all__
