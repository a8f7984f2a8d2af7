"""Measure how exactly engines apply network conditions, more often than `ucp-harness doctor --measure`.

    python -m benchmarks.conditions [--packets N] [--rounds R] [--json]

Each round makes all measurements of `netem.measure` with each engine of this machine, and with the simulated medium. A
row has the mean, minimum and maximum of the measured values. `inside` counts the rounds in which the first confidence
interval (99.9 %) contained the requested value. With a correct engine, it does so in 999 of 1000 rounds.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from statistics import fmean
from typing import get_args

from harness.errors import CANNOT_HERE
from netem.errors import NetemError
from netem.lab import EngineName
from netem.lab_doctor import examine
from netem.measure import PACKETS, EngineMeasurement, Observer, measure, studies
from netem.observers import in_lab, in_medium


def observers() -> dict[str, Observer]:
    """Return the measuring functions for all engines that work on this machine."""
    working = {finding.name for finding in examine() if finding.ok}
    kernel = {engine: in_lab(engine) for engine in get_args(EngineName) if engine in working}
    return {**kernel, "medium": in_medium(seed=1)}


def show(rounds: Mapping[str, list[EngineMeasurement]]) -> None:
    sys.stdout.write(
        f"{'engine':10}{'condition':42}{'quantity':22}{'asked':>11}{'mean':>11}{'min..max':>24}   inside\n"
    )
    for engine, measured in rounds.items():
        for rows in zip(*(one.rows for one in measured), strict=True):
            question, firsts = rows[0].question, [row.before or row.answer for row in rows]
            found = [first.measured for first in firsts]
            spread = f"{min(found):.5g}..{max(found):.5g}"
            inside = sum(row.before is None and row.ok for row in rows)
            sys.stdout.write(
                f"{engine:10}{question.condition:42}{f'{question.quantity} {question.unit}':22}"
                f"{question.asked:>11.5g}{fmean(found):>11.5g}{spread:>24}   {inside} of {len(rows)}\n"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packets", type=int, default=PACKETS, help="packets of each stream")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print all rows of all rounds as JSON")
    options = parser.parse_args()
    engines = observers()
    rounds: dict[str, list[EngineMeasurement]] = {engine: [] for engine in engines}
    try:
        for _ in range(options.rounds):
            for engine, observe in engines.items():
                rounds[engine].append(measure(engine, studies(engine), observe, options.packets))
    except NetemError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(CANNOT_HERE)
    if options.json:
        json.dump([one.to_json() for measured in rounds.values() for one in measured], sys.stdout)
        sys.stdout.write("\n")
    else:
        show(rounds)


if __name__ == "__main__":
    main()
