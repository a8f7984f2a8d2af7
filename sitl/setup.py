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

    `frame` None is the default frame of its type. `log_mib` None means no limit of the log.
    """

    frame: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    debugger: Debugger | None = None
    log_mib: int | None = None


USUAL = VehicleSetup()
"""The default setup."""
