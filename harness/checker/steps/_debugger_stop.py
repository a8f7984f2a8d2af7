"""Stop in a debugger before a handler runs.

This module is never compiled. A compiled function has no frame in which a debugger could stop.
"""

from typing import Any


def stop_and_run(handler: Any, core: Any, *inputs: Any) -> str:
    """Call `breakpoint()`, then run the handler. A debugger can step from the breakpoint into the handler."""
    breakpoint()
    branch: str = handler.run(core, *inputs)
    return branch
