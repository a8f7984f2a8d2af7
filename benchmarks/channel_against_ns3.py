"""Compare the shared radio channel of `netem.channel` with ns-3: `python -m benchmarks.channel_against_ns3 [--jobs J]`.

    pip install ns3==3.44.post0 && python -m benchmarks.channel_against_ns3 --measure [--jobs J]

The first command needs no ns-3. It plays the cells of `channel_ns3.json` in the model, and prints the differences of
the delivery. The second command needs the package ns3 and g++. It compiles `channel_ns3.cc`, plays the cells that
`channel_ns3.json` lacks, and writes this file.

There are three families of cells. In each of them, stations broadcast without acknowledgement and without retry:

- beacons: stations on a circle with a diameter of `metres` send messages of 100 bytes at random times (Poisson). The
  offered load is the sum of the airtimes of all stations, as a share of the time. Delivery is the share of the copies
  that arrive at all other stations.
- hidden: stations on a line, with `metres` between neighbours, send the same messages. The load counts a station and
  its two neighbours. Delivery is the share of the copies that arrive at the neighbours.
- votes: station 0 on the circle sends a question of 78 bytes each second. Each station that receives it answers once,
  with 47 bytes, after a uniformly distributed time up to the jitter. Delivery is the share of the other stations whose
  answer station 0 receives. A majority needs more than half of all stations, with station 0 itself.

In many hidden cells of 802.11g with five stations or more, an assertion of ns-3 fails (phy-entity.cc, line 490). The
table lacks these cells. It has cells of 802.11a in their place, in which the assertion seldom fails.

Some of ns-3's defaults would measure something else, so the program sets or avoids them:

- The stations send frames directly to the WifiNetDevice. The frames contain 28 bytes for the headers of IPv4 and UDP.
  The internet stack would add ARP and the queue of the traffic-control layer.
- The MAC queue has 10 packets in place of 500, so that it soon reaches its steady state. A packet may wait in it for
  1000 s. The default of 500 ms would drop packets of a busy channel.
- The rate of broadcasts is the attribute NonUnicastMode. By default, it is the lowest rate of the standard.
- 1 Mbit/s is 802.11b: DSSS with the long preamble of 192 us, slots of 20 us, SIFS of 10 us, 31 as contention window.
  6 Mbit/s is 802.11g: OFDM with a preamble and header of 20 us, slots of 20 us, SIFS of 10 us, 15 as contention
  window. An ad hoc network at 2.4 GHz uses the long slot (IEEE 802.11-2020, 18.4.5). ns-3 does so, too, and adds the
  6 us of signal extension. 802.11a has slots of 9 us and SIFS of 16 us. Its cells have the same path loss.
- The path loss is that of `netem.radio.LogDistance` with its defaults. LogDistancePropagationLossModel has the same
  exponent and the loss of Friis over the first metre as its reference loss (by default, that of 5.15 GHz).
  RandomPropagationLossModel draws the shadowing of each copy independently.
- The transmission power is 20 dBm in place of 16.02 dBm.
- Preamble detection: a station receives a frame if 4 us after its start the power is at least -82 dBm, which is the
  sensitivity of LogDistance, and the ratio of signal to noise and interference is at least 4 dB. These are ns-3's
  defaults. The carrier is sensed by the same detection. A station that misses a preamble, for example because it sends
  or because two frames collide, senses the channel as busy while the sum of all powers is at least -82 dBm
  (CcaSensitivity). The energy threshold of -62 dBm (CcaEdThreshold) then never decides.
- Frame capture: none, ns-3's default. A station that receives a frame does not change to a stronger one. Within the
  4 us of preamble detection it does.
- The noise figure is 7 dB and the error model is TableBasedErrorRateModel, ns-3's defaults. The error model of DSSS is
  DsssErrorRateModel in any case. Signals below -101 dBm do not interfere.

The model plays with the presets `wifi_1` and `wifi_6`, except for these keys:

- `shadowing_m: 0` draws the shadowing of each copy independently, as above. The preset correlates it.
- `energy_dbm: -82` is CcaSensitivity. The presets have the levels that the standard demands from a receiver that missed
  the preamble, -76 and -62 dBm.
- `sense_s: 4e-6` is the time of preamble detection. The preset `wifi_1` has the CCA time of the standard, 15 us.
- Cells of 802.11a have its slot, DIFS, EIFS and no signal extension.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from heapq import heapify, heappop, heappush, heapreplace
from importlib import metadata
from pathlib import Path
from random import Random
from statistics import fmean, stdev
from typing import Any, Literal

from benchmarks.rounds import show
from harness.errors import CANNOT_HERE
from netem.channel import PRESETS, Channel, FrameFate, WifiRadio
from netem.radio import LogDistance, Place

SOURCE = Path(__file__).with_name("channel_ns3.cc")
TABLE = Path(__file__).with_name("channel_ns3.json")
LIBRARIES = ("core", "network", "mobility", "propagation", "wifi")

QUEUE = 10
QUESTION_BYTES, ANSWER_BYTES, BEACON_BYTES = 78, 47, 100
HEADER_BYTES = 64
"""Bytes of all headers: 28 for IPv4 and UDP, 8 for LLC, 24 for the MAC header, and 4 for the frame check sequence."""

RADIO = LogDistance()
ENERGY_DBM = -62.0
SENSE_S = 4e-6
SETTINGS: dict[str, float | str] = {
    "exponent": RADIO.exponent,
    "reference_db": round(RADIO.power_dbm - RADIO.sensitivity_dbm - RADIO.margin_db(1.0), 4),
    "power_dbm": RADIO.power_dbm,
    "sensitivity_dbm": RADIO.sensitivity_dbm,
    "preamble_db": 4.0,
    "energy_dbm": ENERGY_DBM,
    "noise_figure_db": 7.0,
    "errors": "TableBased",
    "queue": QUEUE,
}

Family = Literal["beacons", "hidden", "votes"]
Standard = Literal["b", "g", "a"]

Rows = list[dict[str, Any]]

STATIONS = (2, 5, 20, 50)
LOADS = (0.01, 0.1, 0.3, 0.6, 0.9, 1.2)
JITTERS_MS = (0.5, 5.0, 48.0)
METRES = (50.0, 150.0, 250.0, 350.0, 500.0)
MESSAGES = {2: 12_000, 3: 12_000, 5: 8_000, 20: 4_000, 50: 2_500}
BATCHES = 20
"""Number of parts of a cell. Their differences give the standard error."""
TOLERANCE = 3.0
"""Maximum difference between the delivery of the model and that of ns-3, in percentage points."""
VOTES = {2: 3_000, 5: 1_500, 20: 400, 50: 120}


@dataclass(frozen=True)
class Cell:
    """One setting of stations and traffic.

    Beacons and hidden stations use `load`. Votes use `jitter_ms`.
    """

    family: Family
    standard: Standard
    n: int
    metres: float
    shadowing_db: float
    load: float = 0.0
    jitter_ms: float = 0.0

    @property
    def per_second(self) -> float:
        """Return the number of messages per second of each station."""
        sharing = 3 if self.family == "hidden" else self.n
        return self.load / sharing / (airtime_us(self.standard, BEACON_BYTES) / 1e6)

    @property
    def messages(self) -> int:
        return VOTES[self.n] if self.family == "votes" else MESSAGES[self.n]

    @property
    def warm_up(self) -> int:
        """Return the number of messages at the beginning that do not count, because the queues are not yet full."""
        return (40 if self.load > 0.6 else 5) * self.n

    @property
    def after(self) -> int:
        """Return the number of messages after the counted ones. They keep the load the same until the last counted
        message.
        """
        return (12 if self.load > 0.6 else 3) * self.n


@dataclass(frozen=True)
class Delivery:
    """Shares from 0 to 1 with their standard errors. `asked` and `majority` are known only for votes."""

    delivered: float
    error: float
    asked: float | None = None
    asked_error: float | None = None
    majority: float | None = None
    majority_error: float | None = None


def airtime_us(standard: Standard, payload: int) -> float:
    """Return the sending time of a UDP datagram in microseconds, without the signal extension of 802.11g."""
    bits = 8 * (payload + HEADER_BYTES)
    return 192.0 + bits if standard == "b" else 20.0 + 4 * math.ceil((22 + bits) / 24)


def cells() -> Iterator[Cell]:
    standards: tuple[Standard, ...] = ("b", "g")
    for n in STATIONS:
        for standard in standards:
            for metres in METRES:
                for load in LOADS:
                    yield Cell("beacons", standard, n, metres, RADIO.shadowing_db, load=load)
                for jitter_ms in JITTERS_MS:
                    yield Cell("votes", standard, n, metres, RADIO.shadowing_db, jitter_ms=jitter_ms)
            for metres in (150.0, 300.0):
                for shadowing_db in (0.0, RADIO.shadowing_db):
                    for load in LOADS:
                        yield Cell("hidden", standard, max(n, 3), metres, shadowing_db, load=load)
    for n in (5, 20):
        for metres in (150.0, 300.0):
            for shadowing_db in (0.0, RADIO.shadowing_db):
                for load in LOADS[2:]:
                    yield Cell("hidden", "a", n, metres, shadowing_db, load=load)


def places(cell: Cell) -> list[Place]:
    """Return the positions of the stations in metres.

    The positions on a line differ by up to 4 m from equal distances. With equal distances, many frames of hidden
    stations would arrive at the same nanosecond.
    """
    if cell.family == "hidden":
        return [Place(0.0, cell.metres * station + 4 * (0.618 * station**2 % 1), 0.0) for station in range(cell.n)]
    angles = [2 * math.pi * station / cell.n for station in range(cell.n)]
    return [Place(cell.metres / 2 * math.sin(angle), cell.metres / 2 * math.cos(angle), 0.0) for angle in angles]


# ns-3


def compile_ns3(directory: Path) -> Path:
    """Compile the program that plays cells in ns-3. Raises PackageNotFoundError, OSError or CalledProcessError."""
    root = Path(str(metadata.distribution("ns3").locate_file("ns3")))
    version = ".".join(metadata.version("ns3").split(".")[:2])
    program, libraries = directory / "channel_ns3", root / "lib64"
    linked = [f"-L{libraries}", f"-Wl,-rpath,{libraries}", *(f"-lns{version}-{library}" for library in LIBRARIES)]
    compiler = ["g++", "-std=c++20", "-O2", f"-I{root}/include", str(SOURCE), "-o", str(program), *linked]
    subprocess.run(compiler, check=True)
    return program


def in_ns3(program: Path, cell: Cell) -> Delivery | None:
    keys = {
        **SETTINGS,
        **asdict(cell),
        "places": ",".join(f"{place.east_m!r}:{place.north_m!r}" for place in places(cell)),
        "question": QUESTION_BYTES,
        "payload": ANSWER_BYTES if cell.family == "votes" else BEACON_BYTES,
        "messages": cell.messages,
        "warm_up": cell.warm_up,
        "after": cell.after,
        "per_second": cell.per_second,
        "seed": 1,
    }
    line = " ".join(f"{key}={value}" for key, value in keys.items()) + "\n"
    played = subprocess.run([program], input=line, capture_output=True, text=True)
    if played.returncode:
        sys.stderr.write(f"Left out: {cell}, in which ns-3 fails: {played.stderr.splitlines()[0]}\n")
        return None
    return Delivery(**{key: round(value, 5) for key, value in json.loads(played.stdout).items()})


def measure(jobs: int) -> None:
    """Play the cells that the table lacks in ns-3. Write the table after each cell."""
    found = read_table() if TABLE.exists() else {}
    missing = [cell for cell in cells() if cell not in found]
    with tempfile.TemporaryDirectory() as directory, ThreadPoolExecutor(jobs) as pool:
        program = compile_ns3(Path(directory))
        for cell, delivery in zip(missing, pool.map(partial(in_ns3, program), missing), strict=True):
            if delivery is not None:
                found[cell] = delivery
                write_table(found)


def write_table(found: dict[Cell, Delivery]) -> None:
    head = json.dumps({"ns3": metadata.version("ns3"), "settings": SETTINGS})
    rows = (
        json.dumps({key: value for key, value in {**asdict(cell), **asdict(delivery)}.items() if value is not None})
        for cell, delivery in found.items()
    )
    TABLE.write_text("[\n" + ",\n".join((head, *rows)) + "\n]\n", encoding="utf-8")


def read_table() -> dict[Cell, Delivery]:
    _, *rows = json.loads(TABLE.read_text(encoding="utf-8"))
    keys = [field.name for field in fields(Cell)]
    return {
        Cell(**{key: row[key] for key in keys}): Delivery(**{key: row[key] for key in row if key not in keys})
        for row in rows
    }


# The model


def radio(cell: Cell) -> WifiRadio:
    """Return the radio model with the settings of ns-3."""
    preset = PRESETS["wifi_1" if cell.standard == "b" else "wifi_6"]
    assert isinstance(preset, WifiRadio)
    if cell.standard == "a":
        preset = replace(preset, slot_s=9e-6, difs_s=34e-6, eifs_s=94e-6, extension_s=0.0)
    return replace(
        preset,
        shadowing_db=cell.shadowing_db,
        shadowing_m=0.0,
        energy_dbm=RADIO.sensitivity_dbm,
        sense_s=SENSE_S,
        queue_frames=QUEUE,
    )


def in_model(cell: Cell) -> Delivery:
    channel = Channel(range(cell.n), radio(cell), seed=1)
    channel.move(places(cell), 0.0)
    return votes(cell, channel) if cell.family == "votes" else beacons(cell, channel)


def beacons(cell: Cell, channel: Channel) -> Delivery:
    rng = Random(1)
    first, last = cell.warm_up, cell.warm_up + cell.messages
    wanted = [
        (1 << station >> 1 | 1 << station + 1) & (1 << cell.n) - 1
        if cell.family == "hidden"
        else (1 << cell.n) - 1 & ~(1 << station)
        for station in range(cell.n)
    ]
    due = [(rng.expovariate(cell.per_second), station) for station in range(cell.n)]
    heapify(due)
    asked, arrived, frames = [0] * BATCHES, [0] * BATCHES, {}
    for number in range(last + cell.after):
        now, station = due[0]
        heapreplace(due, (now + rng.expovariate(cell.per_second), station))
        frame = channel.send(station, now, BEACON_BYTES)
        if first <= number < last:
            batch = BATCHES * (number - first) // cell.messages
            asked[batch] += wanted[station].bit_count()
            if not isinstance(frame, FrameFate):
                frames[frame] = batch
        for sent in channel.advance(now):
            if (batch := frames.pop(sent.number, -1)) >= 0:
                arrived[batch] += (sent.received & wanted[sent.sender]).bit_count()
    shares = [arrivals / copies for arrivals, copies in zip(arrived, asked, strict=True)]
    return Delivery(*mean(shares))


def votes(cell: Cell, channel: Channel) -> Delivery:
    rng = Random(1)
    asked, heard, majority = [], [], []
    for second in range(cell.messages):
        channel.send(0, second, QUESTION_BYTES)
        answers: list[tuple[float, int]] = []
        questioned = answered = 0
        while (event := channel.next_event()) is not None or answers:
            if answers and (event is None or answers[0][0] < event):
                now, station = heappop(answers)
                channel.send(station, now, ANSWER_BYTES)
                continue
            assert event is not None
            for sent in channel.advance(event):
                if sent.sender == 0:
                    questioned = sent.received.bit_count()
                    for station in range(1, cell.n):
                        if sent.received >> station & 1:
                            heappush(answers, (event + rng.uniform(0, cell.jitter_ms / 1000), station))
                else:
                    answered += sent.received & 1
        asked.append(questioned / (cell.n - 1))
        heard.append(answered / (cell.n - 1))
        majority.append(float(2 * (answered + 1) > cell.n))
    return Delivery(*mean(heard), *mean(asked), *mean(majority))


def mean(samples: Sequence[float]) -> tuple[float, float]:
    """Return the mean of the values and its standard error."""
    return fmean(samples), stdev(samples) / math.sqrt(len(samples))


# The comparison


def compare(jobs: int) -> Rows:
    """Play the cells of the table in the model. Return rows with both figures in percent and their difference."""
    table = read_table()
    with ProcessPoolExecutor(jobs) as pool:
        played = dict(zip(table, pool.map(in_model, table, chunksize=8), strict=True))
    rows: Rows = []
    for cell, ns3 in table.items():
        model = played[cell]
        rows.append(
            {
                **asdict(cell),
                "ns-3": 100 * ns3.delivered,
                "model": 100 * model.delivered,
                "difference": 100 * (model.delivered - ns3.delivered),
                "error": 100 * math.hypot(ns3.error, model.error),
            }
        )
    return rows


def summary(rows: Rows) -> Rows:
    """Return, for each group of cells, their number and the lowest and highest difference."""
    groups: dict[tuple[str, str, int], list[float]] = {}
    for row in rows:
        groups.setdefault((row["family"], row["standard"], row["n"]), []).append(row["difference"])
    return [
        {
            "family": family,
            "802.11": standard,
            "n": n,
            "cells": len(found),
            "within": sum(abs(points) <= TOLERANCE for points in found),
            "lowest": min(found),
            "highest": max(found),
        }
        for (family, standard, n), found in sorted(groups.items())
    ]


def show_differences(rows: Rows) -> None:
    beyond = [row for row in rows if abs(row["difference"]) > TOLERANCE]
    within = len(rows) - len(beyond)
    show(summary(rows), {"lowest": ".1f", "highest": ".1f"}, as_json=False)
    sys.stdout.write(
        f"\n{within} of {len(rows)} cells ({within / len(rows):.1%}) differ by {TOLERANCE:g} points at most.\n"
    )
    if beyond:
        sys.stdout.write("\nThe others, in percent and points:\n")
        forms = dict.fromkeys(("ns-3", "model", "difference", "error"), ".1f")
        show(sorted(beyond, key=lambda row: row["difference"]), forms, as_json=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="play all cells in ns-3 and write channel_ns3.json")
    parser.add_argument("--jobs", type=int, default=1, help="number of cells to play at the same time")
    options = parser.parse_args()
    if options.measure:
        try:
            measure(options.jobs)
        except metadata.PackageNotFoundError:
            sys.stderr.write("The package ns3 is missing: install it with `pip install ns3==3.44.post0`.\n")
            sys.exit(CANNOT_HERE)
        except FileNotFoundError:
            sys.stderr.write("The compiler g++ is missing: install the package g++.\n")
            sys.exit(CANNOT_HERE)
        return
    show_differences(compare(options.jobs))


if __name__ == "__main__":
    main()
