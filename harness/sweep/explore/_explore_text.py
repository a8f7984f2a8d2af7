"""Print the output of the command `explore`."""

import contextlib
import time
from collections.abc import Iterator

from rich.console import Console

from harness.run.simulate import evidence_lines
from harness.scenario.verdict_names import BAD_IN_WORDS
from harness.sweep.explore._exploring import Explored, SearchProgress, ViolatingRun

_MAX_SEEDS = 10
"""Maximum number of seeds that one sentence of the output lists."""
LINE_EVERY_S = 10.0
REDRAW_EVERY_S = 0.1
CLEAR_LINE = "\r\x1b[2K"


@contextlib.contextmanager
def watching(console: Console) -> Iterator[SearchProgress]:
    """Yield functions that print each violation, and the progress of the search for a smaller scenario.

    On a terminal, the progress is one line that changes. Other outputs get a line every ten seconds.
    """
    every_s = REDRAW_EVERY_S if console.is_terminal else LINE_EVERY_S
    last = 0.0

    def on_violation(violation: ViolatingRun) -> None:
        words = " and ".join(BAD_IN_WORDS[key] for key in violation.keys)
        console.print(f"seed {violation.seed}: {words}; shrinking", highlight=False)

    def on_step(runs: int, words: str) -> None:
        nonlocal last
        if time.monotonic() - last >= every_s:
            last = time.monotonic()
            so_far = f"{words} after {runs} {'run' if runs == 1 else 'runs'}"
            if console.is_terminal:
                console.file.write(f"{CLEAR_LINE}{so_far}"[: console.width + len(CLEAR_LINE)])
                console.file.flush()
            else:
                console.print(so_far, highlight=False, soft_wrap=True)

    try:
        yield SearchProgress(on_violation, on_step, shown=True)
    finally:
        if console.is_terminal:
            console.file.write(CLEAR_LINE)


def in_words(explored: Explored) -> Iterator[str]:
    played = explored.searched.played
    yield f"{played} seed{'' if played == 1 else 's'} played" + (
        "" if explored.searched.violation else ": no characteristic is violated"
    )
    if seeds := explored.searched.unfinished:
        listed = ", ".join(map(str, seeds[:_MAX_SEEDS])) + (", ..." if len(seeds) > _MAX_SEEDS else "")
        yield f"not finished: {len(seeds)} of them need a longer mission to be judged, seeds {listed}"
    if explored.shrunk:
        yield from evidence_lines(explored.shrunk.violated)
        yield explored.shrunk.words
        yield str(explored.shrunk.path)
        yield explored.shrunk.replay
