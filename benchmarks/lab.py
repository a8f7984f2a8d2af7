"""Measure the start and stop of the virtual network: `python -m benchmarks.lab [--rounds R] [--json] [--mininet] [N
...]`.

With `--mininet`, each round also starts and stops the same number of Mininet hosts on one Linux bridge. This needs root
and the Debian packages mininet and bridge-utils. The benchmark compares Mininet's `build` and `start` with `Lab.open`,
and Mininet's `stop` with `Lab.close`. Each ratio compares the two in the same round. The time of the lab includes the
start of its first process. The time of Mininet does not.

`--pairs` measures `Lab.apply` instead, with each engine that works on this machine. Each directed pair of vehicles
first gets its own loss rate (`first`), and then a different one (`change`).
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, get_args

from benchmarks.rounds import Spread, show
from netem import _namespaces
from netem.conditions import LinkConditions, NetworkConditions
from netem.lab import EngineName, Lab, LabError, LabUnavailable

_PYTHON = "/usr/bin/python3"  # Debian's, which has Debian's Mininet
_MININET = Path(__file__).with_name("mininet_network.py")
_MININET_DEADLINE_S = 600.0
_PAUSE_S = 0.5  # the kernel removes the last namespaces in the background

_SECONDS = ("up", "mininet_up", "down", "mininet_down", "first", "change")
_FORMS = {**{f"{key}_s": ".3f" for key in _SECONDS}, "up_ratio": ".1f", "down_ratio": ".1f"}

_Row = dict[str, Any]


class _CannotError(Exception):
    """An error: this machine lacks a requirement. The message names the requirement."""


async def lab_once(vehicles: int, log: Path) -> _Row:
    """Return the seconds that a virtual network takes to start and to stop, and the name of its engine."""
    start = time.perf_counter()
    lab = await Lab.open(range(1, vehicles + 1), log=log)
    up = time.perf_counter()
    await lab.close()
    return {"engine": lab.engine, "up_s": up - start, "down_s": time.perf_counter() - up}


def mininet_once(hosts: int) -> _Row:
    """Return the seconds that Mininet takes to start and to stop this number of hosts."""
    argv = _namespaces.command([_PYTHON, str(_MININET), str(hosts)], user_namespace=False)
    done = subprocess.run(argv, capture_output=True, text=True, timeout=_MININET_DEADLINE_S, check=False)
    if done.returncode != 0:
        raise SystemExit(f"Mininet failed with {hosts} hosts:\n{done.stderr}")
    found: _Row = json.loads(done.stdout)
    return found


def check_mininet() -> None:
    if os.geteuid() != 0:
        raise _CannotError("Mininet needs root: run this as root, or without --mininet.")
    importable = subprocess.run([_PYTHON, "-c", "import mininet.net"], capture_output=True, check=False).returncode == 0
    if not (importable and shutil.which("brctl")):
        raise _CannotError(
            "Mininet is not installed (Debian: apt install --no-install-recommends mininet bridge-utils)."
        )


def up_and_down(vehicles: int, rounds: int, mininet: bool, log: Path) -> _Row:
    labs, networks = [], []
    for _ in range(rounds):
        labs.append(asyncio.run(lab_once(vehicles, log)))
        time.sleep(_PAUSE_S)
        if mininet:
            networks.append(mininet_once(vehicles))
            time.sleep(_PAUSE_S)
    row: _Row = {"vehicles": vehicles, "engine": labs[0]["engine"]}
    for key in ("up", "down"):
        ours = [lab[f"{key}_s"] for lab in labs]
        row[f"{key}_s"] = Spread.of(ours)
        if mininet:
            theirs = [network[f"{key}_s"] for network in networks]
            row[f"mininet_{key}_s"] = Spread.of(theirs)
            row[f"{key}_ratio"] = Spread.of_ratios(theirs, ours)
    return row


def pairs(vehicles: int, rounds: int, log: Path) -> list[_Row]:
    """Return a table row for each engine that works on this machine."""
    rows, refusals = [], []
    for engine in get_args(EngineName):
        try:
            found = [asyncio.run(pairs_once(vehicles, engine, log)) for _ in range(rounds)]
        except LabUnavailable as error:
            refusals.append(error)
            sys.stderr.write(f"Left out: {error.reason}\n")
            continue
        first, change = (Spread.of(seconds) for seconds in zip(*found, strict=True))
        links = vehicles * (vehicles - 1)
        rows.append({"vehicles": vehicles, "links": links, "engine": engine, "first_s": first, "change_s": change})
    if not rows:
        raise refusals[0]
    return rows


async def pairs_once(vehicles: int, engine: EngineName, log: Path) -> tuple[float, float]:
    """Return the seconds to set a loss rate for each pair of vehicles, and the seconds to change all loss rates."""
    directed = list(itertools.permutations(range(1, vehicles + 1), 2))
    losses = [number / (len(directed) + 1) for number in range(1, len(directed) + 1)]
    seconds = []
    async with await Lab.open(range(1, vehicles + 1), engine=engine, log=log) as lab:
        for some in (losses, losses[::-1]):
            links = dict(zip(directed, map(LinkConditions, some), strict=True))
            start = time.perf_counter()
            await lab.apply(NetworkConditions(links=links))
            seconds.append(time.perf_counter() - start)
    first, change = seconds
    return first, change


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("vehicles", nargs="*", type=int, metavar="N", help="vehicles (5 20 50 100; with --pairs 100)")
    parser.add_argument("--rounds", type=int, default=3, help="number of rounds")
    parser.add_argument("--json", action="store_true", help="print JSON")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--mininet", action="store_true", help="compare with Mininet")
    what.add_argument("--pairs", action="store_true", help="measure losses for each directed pair")
    options = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder, "lab.log")
            if options.pairs:
                counts = options.vehicles or [100]
                rows = [row for count in counts for row in pairs(count, options.rounds, log)]
            else:
                if options.mininet:
                    check_mininet()
                counts = options.vehicles or [5, 20, 50, 100]
                rows = [up_and_down(count, options.rounds, options.mininet, log) for count in counts]
    except (LabError, _CannotError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
    show(rows, _FORMS, options.json)


if __name__ == "__main__":
    main()
