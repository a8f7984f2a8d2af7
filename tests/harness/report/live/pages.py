"""Start a command that serves a page, and wait until the page has the expected content."""

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.harness.command import COMMAND, DEADLINE_S
from tests.harness.report.browser import Browser


@contextmanager
def page_of(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the command and yield it with the address of its page. Afterwards end it with Ctrl-C."""
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        line = next(line for line in process.stdout if "http://" in line)
        yield process, line.split()[-1]
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)


def until(browser: Browser, expression: str) -> Any:
    """Wait until the value of the JavaScript expression is true, and return the value."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        if value := browser.evaluate(expression):
            return value
        time.sleep(0.1)
    raise AssertionError(f"{expression} comes to nothing; {browser.complaints}")
