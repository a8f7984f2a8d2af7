"""What no reader may do with any input: raise anything but its own error, take long or much, ramble, or lie."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

MOST_S = 20.0
MOST_GROWTH_BYTES = 512 * 1024 * 1024
LONGEST_SENTENCE = 2000


class FailedError(AssertionError):
    """A reader did what none may do with any input."""


@contextmanager
def bounded() -> Iterator[None]:
    """Raises FailedError if it takes too long, or too much memory."""

    def too_long(signal_number: int, frame: FrameType | None) -> None:
        raise FailedError(f"took more than {MOST_S} s")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    former = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, MOST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if grown > MOST_GROWTH_BYTES:
        raise FailedError(f"took {grown >> 20} MiB more memory")


def sound(sentence: str) -> None:
    """A sentence for people is one line, is not endless, and is no traceback."""
    require(len(sentence) < LONGEST_SENTENCE, f"a sentence of {len(sentence)} characters: {sentence[:200]}")
    require("\n" not in sentence, f"more than a sentence: {sentence[:200]}")
    require("Traceback" not in sentence, f"a traceback: {sentence[:200]}")


def require(holds: Any, otherwise: str) -> None:
    if not holds:
        raise FailedError(otherwise)
