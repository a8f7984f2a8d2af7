"""Test the program that measures the delays of the machine during a run."""

import io
import json
import threading
import time

from harness.play.process._lag_probe import measure

STALL_S = 0.3


class StallingCounters:
    """Counters whose second reading takes long without using the processor, as if the machine had stopped the
    program.
    """

    def __init__(self) -> None:
        self.readings = 0
        self.ended = threading.Event()

    def busy(self) -> dict[str, float]:
        self.readings += 1
        if self.readings == 2:
            time.sleep(STALL_S)
        if self.readings == 3:
            self.ended.set()
        return {"1": 0.0}

    def stalled(self) -> float:
        return 0.0


def test_delay_while_the_program_reads_its_counters_is_measured() -> None:
    counters, file = StallingCounters(), io.StringIO()
    began = time.monotonic()
    measure(file, began, 1.0, counters, counters.ended)  # type: ignore[arg-type]
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert lines[1]["machine_s"] > 0.9 * STALL_S
