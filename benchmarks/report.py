"""Measure the report of a run: `python -m benchmarks.report [--agents 5 20 50] [--rounds 5] [--json]`.

Each run takes 20 minutes in virtual time with 15 % loss. The benchmark judges the run first. 50 agents write over a
million trace lines, and the judgement takes two minutes. Each round then writes the report. It also reads the trace
lines without using them, for comparison. The ratio compares the time for the report with the time for reading. Times
are processor seconds, without the start of Python.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.rounds import Spread, show
from benchmarks.simulation import scenario, seconds
from harness.archive.archive import RunArchive
from harness.archive.trace_files import SUFFIX
from harness.play.progress import SilentProgress
from harness.report import write_report
from harness.run.run import run

MEGABYTE = 1e6


def lines_alone(traces: list[Path]) -> int:
    """Read the traces without using their lines. Return the number of lines."""
    count = 0
    for path in traces:
        with path.open("rb") as file:
            count += sum(1 for _ in file)
    return count


def row(agents: int, rounds: int, directory: Path) -> dict[str, Any]:
    run(scenario(agents, 0.15, 7200.0), 7, directory, SilentProgress(), "sim")
    traces = list((directory / "agents").glob(f"*{SUFFIX}"))
    reports, lines = [], []
    for _ in range(rounds):
        reports.append(seconds(lambda: write_report(RunArchive(directory, skim=True))))
        lines.append(seconds(lambda: lines_alone(traces)))
    return {
        "agents": agents,
        "lines": lines_alone(traces),
        "traces, MB": round(sum(path.stat().st_size for path in traces) / MEGABYTE),
        "page, MB": f"{(directory / 'report.html').stat().st_size / MEGABYTE:.2f}",
        "report, s": Spread.of(reports),
        "lines alone, s": Spread.of(lines),
        "ratio": Spread.of_ratios(reports, lines),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="+", default=[5, 20, 50], help="numbers of agents")
    parser.add_argument("--rounds", type=int, default=5, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    rows = []
    for agents in arguments.agents:
        with tempfile.TemporaryDirectory() as directory:
            rows.append(row(agents, arguments.rounds, Path(directory) / "run"))
    show(rows, {"report, s": ".2f", "lines alone, s": ".2f", "ratio": ".1f"}, arguments.json)


if __name__ == "__main__":
    main()
