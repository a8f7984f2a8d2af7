"""Run simulated vehicles: ArduPilot SITL or the embedded vehicle model, and a pilot that flies them over MAVLink.

`__all__` lists the public names. Every embedded vehicle imports this package. To let the vehicles start faster, Python
imports a public name only when a program first uses the name.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sitl.ardupilot import ArduPilot
    from sitl.embedded import Embedded
    from sitl.pilot import Pilot
    from sitl.plan import GoTo, Land, Loiter, Plan, PlanError, TakeOff
    from sitl.vehicle import Home, Launch, VehicleError, VehicleKind

__all__ = [
    "ArduPilot",
    "Embedded",
    "GoTo",
    "Home",
    "Land",
    "Launch",
    "Loiter",
    "Pilot",
    "Plan",
    "PlanError",
    "TakeOff",
    "VehicleError",
    "VehicleKind",
]

_NAMES_OF = {
    "sitl.ardupilot": ("ArduPilot",),
    "sitl.embedded": ("Embedded",),
    "sitl.pilot": ("Pilot",),
    "sitl.plan": ("GoTo", "Land", "Loiter", "Plan", "PlanError", "TakeOff"),
    "sitl.vehicle": ("Home", "Launch", "VehicleError", "VehicleKind"),
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
