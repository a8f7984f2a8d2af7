"""Test the program that measures the delays of the machine during a run."""

import io
import json
import threading
import time
from collections.abc import Callable

import pytest

from harness.play.process._lag_probe import measure

STALL_S = 0.3


def compute(seconds: float) -> None:
    """Use the processor, as a program in User Mode Linux seems to do while the host stops User Mode Linux."""
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        pass


class StallingCounters:
    """Counters whose second reading takes long, as if the machine had stopped the program."""

    def __init__(self, stall: Callable[[float], None]) -> None:
        self._stall = stall
        self.readings = 0
        self.ended = threading.Event()

    def busy(self) -> dict[str, float]:
        self.readings += 1
        if self.readings == 2:
            self._stall(STALL_S)
        if self.readings == 3:
            self.ended.set()
        return {"1": 0.0}

    def stalled(self) -> float:
        return 0.0


@pytest.mark.parametrize("stall", [time.sleep, compute])
def test_delay_while_the_program_reads_its_counters_is_measured(stall: Callable[[float], None]) -> None:
    counters, file = StallingCounters(stall), io.StringIO()
    began = time.monotonic()
    measure(file, began, 1.0, counters, counters.ended)  # type: ignore[arg-type]
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert lines[1]["machine_s"] > 0.9 * STALL_S
