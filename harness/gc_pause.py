"""Python's cycle collector, for what makes a million objects and no cycle: it would look at them again and again.

For handler runs, made by a simulation or read for a report, that is a third of the time; of the import of a command
an eighth. A simulated run leaves no cycles: all of it goes when it is let go.
"""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def gc_paused() -> Iterator[None]:
    """A context, or a decorator, in which it does not look."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.freeze()
            gc.unfreeze()  # what was made meanwhile counts as old now, and nobody looks at it at once
            gc.enable()
