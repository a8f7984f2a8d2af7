"""What may differ between two vehicles of one type: frame, parameters, arguments, a debugger, how much they log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

Debugger = Literal["gdb", "valgrind"]
DEBUGGERS: tuple[Debugger, ...] = get_args(Debugger)


@dataclass(frozen=True)
class Setup:
    """Of one vehicle. `frame` None is that of its type; `log_mib`, what its log may hold, is without bound if None."""

    frame: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    debugger: Debugger | None = None
    log_mib: int | None = None


USUAL = Setup()
"""As the type comes."""
