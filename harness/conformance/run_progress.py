"""How far the run is: a bar on a terminal, or a line now and then."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

REDRAW_EVERY_S, LINE_EVERY_S = 0.2, 10.0


@contextmanager
def progress() -> Iterator[Callable[[int, int], None]]:
    """A function that is told how many vectors have passed, of how many."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal)
    task = bar.add_task("vectors", total=None)
    last = time.monotonic()

    def told(count: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last < (REDRAW_EVERY_S if console.is_terminal else LINE_EVERY_S):
            return
        last = time.monotonic()
        bar.update(task, completed=count, total=total, refresh=True)
        if not console.is_terminal:
            console.print(f"{count} of {total} vectors", highlight=False, soft_wrap=True)

    with bar:
        yield told
