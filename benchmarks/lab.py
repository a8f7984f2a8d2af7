"""How long the lab takes to come up and go away: `python -m benchmarks.lab [--rounds R] [--json] [N ...]`."""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

from netem.lab import Lab


async def once(vehicles: int, log: Path) -> tuple[float, float, str]:
    """Seconds up, seconds down, and the engine, for a lab of so many vehicles."""
    start = time.perf_counter()
    lab = await Lab.open(range(1, vehicles + 1), log=log)
    up = time.perf_counter()
    await lab.close()
    return up - start, time.perf_counter() - up, lab.engine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("vehicles", nargs="*", type=int, default=[5, 20, 50, 100])
    parser.add_argument("--rounds", type=int, default=3, help="the median of so many is shown")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for count in options.vehicles:
            rounds = [asyncio.run(once(count, Path(folder, "lab.log"))) for _ in range(options.rounds)]
            up, down = (statistics.median(seconds) for seconds in list(zip(*rounds, strict=True))[:2])
            rows.append({"vehicles": count, "engine": rounds[0][2], "up_s": round(up, 3), "down_s": round(down, 3)})
    if options.json:
        json.dump(rows, sys.stdout)
        sys.stdout.write("\n")
    else:
        sys.stdout.write("vehicles  engine      up        down\n")
        for row in rows:
            sys.stdout.write(f"{row['vehicles']:8}  {row['engine']:10}  {row['up_s']:.3f} s   {row['down_s']:.3f} s\n")


if __name__ == "__main__":
    main()
