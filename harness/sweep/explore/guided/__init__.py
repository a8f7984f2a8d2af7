"""Explore scenarios for hours, guided by coverage, and continue every night. See docs/how-to/explore-every-night.md.

`_hunt` changes a kept scenario (`_mutation`), plays it (`_hunt_trial`) and keeps it if it reaches a new state, branch
or livelock. `_corpus` stores scenarios and findings in a directory. `identities` decides whether two runs show
the same finding. `_night` first plays known findings, then continues the hunt until the time is over, and writes a
page.
"""

import contextlib
import time
from collections.abc import Iterator

from rich.console import Console

from harness.proof.coverage import in_words as coverage_in_words
from harness.sweep.explore.guided._night import NightProgress, NightResult, spend
from harness.sweep.explore.guided._night_page import unfinished_in_words

REDRAW_EVERY_S = 0.1
FIRST_LINE_S, LINES_GROW, LONGEST_S = 10.0, 1.5, 600.0
"""If the output is no terminal, these values determine when progress lines are printed: the number of seconds before
the first line, the factor by which each interval grows, and the maximum interval in seconds.
"""
CLEAR_LINE = "\r\x1b[2K"


@contextlib.contextmanager
def watching(console: Console) -> Iterator[NightProgress]:
    """Yield functions that print the progress of a night.

    On a terminal, the progress is one line that changes. Other outputs get lines at growing intervals.
    """
    began = last = time.monotonic()
    every_s = REDRAW_EVERY_S if console.is_terminal else FIRST_LINE_S

    def on_progress(runs: int, states: int, findings: int) -> None:
        nonlocal last, every_s
        if time.monotonic() - last < every_s:
            return
        last = time.monotonic()
        words = f"{last - began:.0f} s: {runs:,} runs, {states:,} local states, {findings} findings"
        if console.is_terminal:
            console.file.write(f"{CLEAR_LINE}{words}"[: console.width + len(CLEAR_LINE)])
            console.file.flush()
        else:
            every_s = min(every_s * LINES_GROW, LONGEST_S)
            console.print(words, highlight=False, soft_wrap=True)

    def on_event(words: str) -> None:
        if console.is_terminal:
            console.file.write(CLEAR_LINE)
        console.print(words, highlight=False, soft_wrap=True, markup=False)

    try:
        yield NightProgress(on_progress, on_event)
    finally:
        if console.is_terminal:
            console.file.write(CLEAR_LINE)


def in_words(night: NightResult) -> Iterator[str]:
    """Yield the lines that the command prints at the end of a night."""
    for finding in night.findings:
        of = f", appears with {finding.shown} of {finding.of} seeds" if finding.of else ""
        yield f"{finding.status}: {finding.finding.identity}{of}"
        if finding.replay:
            yield f"  {finding.replay}"
    if not night.findings:
        yield "no findings"
    for candidate, reason in night.hunt.failed[:3]:
        yield f"no verdict on the run with seed {candidate.seed}: {reason}"
    if night.hunt.unfinished:
        yield unfinished_in_words(night.hunt.unfinished)
    yield f"{night.hunt.runs:,} runs, {len(night.hunt.kept):,} kept in {night.directory}"
    yield from coverage_in_words(night.hunt.reached, night.existing_states)
    yield f"{night.report}"


__all__ = ["NightResult", "in_words", "spend", "watching"]
