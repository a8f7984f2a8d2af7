"""Run an event loop until a condition is true."""

import time
from collections.abc import Callable

from ucp.loop import Loop

DEADLINE_S = 10.0
LOOK_EVERY_S = 0.005


def run_until(loop: Loop, condition: Callable[[], bool], *, after_s: float = 0.0) -> None:
    """Run the loop until the condition is true. The condition is checked for the first time after `after_s` seconds."""
    deadline = time.monotonic() + DEADLINE_S
    met = False

    def look() -> None:
        nonlocal met
        met = condition()
        if met or time.monotonic() > deadline:
            loop.stop()
        else:
            loop.call_later(LOOK_EVERY_S, look)

    loop.call_later(after_s, look)
    loop.run()
    assert met, "it never happened"
