"""Where a handler's code is, so that one can open it there."""

import inspect
from collections.abc import Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path

from ucp.agent import HANDLERS


@cache
def source_of(handler: str) -> str:
    """Such as "ucp/reconcile.py:187": its first statement, where a breakpoint stops each time that it runs.

    From the working directory, if the code is below that.
    """
    code = HANDLERS[handler].run.__code__
    defined = code.co_firstlineno + sum(1 for line in _decorators(handler))
    line = min(line for _, _, line in code.co_lines() if line is not None and line > defined)
    path, working = Path(code.co_filename), Path.cwd()
    return f"{path.relative_to(working) if path.is_relative_to(working) else path}:{line}"


def _decorators(handler: str) -> Iterator[str]:
    """The lines before its `def`, which run when the module is imported."""
    lines, _ = inspect.getsourcelines(HANDLERS[handler].run)
    return takewhile(lambda line: not line.startswith("def "), lines)
