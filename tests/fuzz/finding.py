"""Define the conditions for every reader of external input: limits of time and memory, and short error messages."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

MOST_S = 20.0
"""Maximum processor time for an input in seconds. The load of the machine does not affect it."""
MOST_WALL_S = 300.0
"""Maximum wall time for an input in seconds. It applies to readers that wait without computing."""
MOST_GROWTH_BYTES = 512 * 1024 * 1024
LONGEST_SENTENCE = 2000


class FailedError(AssertionError):
    """An error: a reader violated a condition."""


@contextmanager
def bounded() -> Iterator[None]:
    """Raise FailedError if the code in the block exceeds a limit.

    The limits are MOST_S for processor time, MOST_WALL_S for wall time, and MOST_GROWTH_BYTES for additional memory.
    """

    def too_long(signal_number: int, frame: FrameType | None) -> None:
        raise FailedError(f"took more than {MOST_S} s" if signal_number == signal.SIGPROF else "waits without end")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    former = [(number, signal.signal(number, too_long)) for number in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, MOST_S)
    signal.setitimer(signal.ITIMER_REAL, MOST_WALL_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in former:
            signal.signal(number, handler)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if grown > MOST_GROWTH_BYTES:
        raise FailedError(f"took {grown >> 20} MiB more memory")


def sound(sentence: str) -> None:
    """Check that an error message is one short line without a traceback. Raises FailedError."""
    require(len(sentence) < LONGEST_SENTENCE, f"a sentence of {len(sentence)} characters: {sentence[:200]}")
    require("\n" not in sentence, f"more than a sentence: {sentence[:200]}")
    require("Traceback" not in sentence, f"a traceback: {sentence[:200]}")


def require(holds: Any, otherwise: str) -> None:
    if not holds:
        raise FailedError(otherwise)
