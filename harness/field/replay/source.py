"""Where a handler's code is, so that one can open it there."""

import inspect
from functools import cache
from pathlib import Path

from ucp.agent import HANDLERS


@cache
def source_of(handler: str) -> str:
    """Such as "ucp/reconcile.py:231", the line of its `def`; from the working directory, if the code is below that."""
    run = HANDLERS[handler].run
    lines, first = inspect.getsourcelines(run)
    line = first + next(count for count, text in enumerate(lines) if text.lstrip().startswith("def "))
    path = Path(inspect.getsourcefile(run) or "")
    working = Path.cwd()
    return f"{path.relative_to(working) if path.is_relative_to(working) else path}:{line}"
