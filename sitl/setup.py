"""Settings that may differ between vehicles of the same type: frame, parameters, arguments, debugger and log size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

Debugger = Literal["gdb", "valgrind"]
DEBUGGERS: tuple[Debugger, ...] = get_args(Debugger)


@dataclass(frozen=True)
class VehicleSetup:
    """The settings of one vehicle.

    If `frame` is None, the vehicle has the default frame of its type. If `log_mib` is None, the size of the log is not
    limited.
    """

    frame: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    debugger: Debugger | None = None
    log_mib: int | None = None


USUAL = VehicleSetup()
"""The default setup."""
