"""Count the flights that `reconstruct` reproduces with the same chains, and the reasons for failures.

    python -m benchmarks.reconstructing [--simulated N] [--processes N] [--first NUMBER]

The number of a flight determines its scenario. Scenarios contain loss, bursts, partitions, kills and restarts, pauses,
wrong and drifting clocks, and settings for readings of the thesis. In virtual time the traces have the times of the
agents' own clocks, without a record of the clock errors. `reconstruct` gets only files that vehicles have: traces,
exports and captures. In some flights the files of one agent are missing. In others, one trace is cut in half, or there
are only exports and captures.
"""

import argparse
import asyncio
import json
import shutil
import statistics
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any, Literal

from benchmarks import clean_runs
from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.errors import HarnessError
from harness.field.ingest import ingest_files
from harness.field.reconstruct import reconstruct
from harness.play.backends import BACKENDS
from harness.play.mission import play_on
from harness.play.progress import SilentProgress
from harness.run.parallel import sweep
from harness.scenario import Scenario

JOBS = 2

Kind = Literal["complete", "one agent missing", "a trace cut in half", "exports and captures only"]
KINDS: dict[int, Kind] = {7: "one agent missing", 8: "a trace cut in half", 9: "exports and captures only"}
"""The kind of a flight, by the last digit of the flight's number. Flights with other digits are complete."""


@dataclass(frozen=True)
class Tried:
    """The result for one flight.

    `expected` is the number of chains that can be reproduced. The chain of an agent with a cut record does not count.
    """

    kind: Kind
    backend: str
    expected: int
    reproduced: int
    blocks: int
    took_s: float
    inputs: int
    why: tuple[str, ...]

    @property
    def whole(self) -> bool:
        return self.reproduced >= self.expected


def kind_of(number: int) -> Kind:
    return KINDS.get(number % 10, "complete")


def scenario(number: int, backend: BackendName) -> Scenario:
    drawn = clean_runs.scenario(number).model_dump(mode="json", exclude_defaults=True, by_alias=True)
    draw = Random(f"reconstructing {number}")
    drawn["capture"] = kind_of(number) == "exports and captures only"
    agents = drawn.get("agents", 5)
    if backend == "process":
        drawn.pop("clocks", None)
        drawn |= {"agents": min(agents, 6), "duration_s": 300.0, "speedup": draw.choice([20, 30, 40])}
        drawn |= {
            "vehicles": {"kind": "none"},
            "settle": {"limit_s": 300},
            "network": {"loss": draw.choice([0, 0.15, 0.3])},
        }
        drawn["timeline"] = _within(clean_runs.scenario(number), 300.0, min(agents, 6))
        drawn["events"] = {"source": "random", "mean_s": 10.0}
    elif drawn["capture"]:
        drawn.pop("clocks", None)  # in virtual time captures use one clock
    elif draw.random() < 0.6:
        drawn["clocks"] = {
            agent: {
                "offset_s": draw.uniform(0, 200),
                "drift": draw.choice([1e-5, 1e-4, 1e-3, 1e-2]) * draw.uniform(-1, 1),
            }
            for agent in range(1, agents + 1)
        }
    return Scenario.model_validate(drawn)


def _within(drawn: Scenario, duration_s: float, agents: int) -> list[dict[str, Any]]:
    """Return the drawn timeline with its times scaled to a shorter flight.

    Return an empty list if an entry of the timeline names an agent that the flight does not have, or has no effect.
    """
    shorter = duration_s / drawn.duration_s
    entries = [entry.model_dump(mode="json", exclude_defaults=True) for entry in drawn.timeline]
    named = {agent for entry in entries for agent in _agents_in(entry)}
    if any(agent > agents for agent in named) or any(not entry.get("heal") and len(entry) < 2 for entry in entries):
        return []
    return [{**entry, "at_s": round(entry["at_s"] * shorter, 3)} for entry in entries]


def _agents_in(entry: dict[str, Any]) -> Iterator[int]:
    for value in entry.values():
        for item in value if isinstance(value, list) else ():
            yield from item if isinstance(item, list) else [item]


def fly(number: int, backend: BackendName) -> Tried:
    asked = scenario(number, backend)
    with TemporaryDirectory(prefix="reconstructing-") as kept:
        run, home = Path(kept) / "run", Path(kept) / "home"
        home.mkdir()
        opening = BACKENDS[backend].open(asked, number, RunDirectory(run), SilentProgress(), asyncio.Event())
        asyncio.run(play_on(opening, asked))
        expected = _bring_home(run, home, kind_of(number), Random(f"home {number}"))
        began = time.monotonic()
        try:
            made = reconstruct(ingest_files([home]).largest(), "again")
        except HarnessError as error:
            return Tried(kind_of(number), backend, expected, 0, 0, time.monotonic() - began, 0, (str(error),))
        took_s = time.monotonic() - began
        inputs = sum(len(timed_inputs) for timed_inputs in made.table.inputs.values())
        reproduced = len(made.reproduced) if made.difference is None else 0
        why = tuple(made.problems)
        return Tried(kind_of(number), backend, expected, reproduced, made.blocks, took_s, inputs, why)


def _bring_home(run: Path, home: Path, kind: Kind, draw: Random) -> int:
    """Copy the files of the vehicles. Return the number of chains that can be reproduced."""
    traces = sorted((run / "agents").glob("*.trace.jsonl"))
    exports = sorted((run / "agents").glob("*.chain.json"))
    struck = draw.choice(traces).name.partition(".")[0]
    if kind == "exports and captures only":
        for path in [*exports, *(run / "capture").glob("*.pcapng")]:
            shutil.copy(path, home)
        return len(exports)
    for path in [*traces, *exports]:
        if kind == "one agent missing" and path.name.startswith(f"{struck}."):
            continue
        if path in traces:
            lines = _by_own_clock(path)
            if kind == "a trace cut in half" and path.name.startswith(f"{struck}."):
                text = "".join(lines)
                (home / path.name).write_text(text[: len(text) // 2])
            else:
                (home / path.name).write_text("".join(lines))
        else:
            shutil.copy(path, home)
    return len(traces) if kind == "complete" else len(traces) - 1


def _by_own_clock(path: Path) -> list[str]:
    """Return the lines of a trace with the times that the agent's own clock showed, without the record of its clock
    error.
    """
    lines = path.read_text().splitlines(keepends=True)
    clock = json.loads(lines[0])["clock"]
    offset_s, rate = clock.get("offset_s", 0.0), 1 + clock.get("drift", 0.0)
    if (offset_s, rate) == (0.0, 1.0):
        return lines
    shown = []
    for line in lines:
        record = json.loads(line)
        if "t" in record:
            record["t"] = round(offset_s + rate * record["t"], 6)
        elif "schema" in record:
            record["clock"] = {"epoch_us": 0, "speedup": 1}
        shown.append(json.dumps(record, separators=(",", ":")) + "\n")
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.reconstructing",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--simulated", type=int, default=200, help="number of flights in virtual time")
    parser.add_argument("--processes", type=int, default=0, help="number of flights with processes")
    parser.add_argument("--first", type=int, default=0, help="number of the first flight")
    asked = parser.parse_args()
    tried: list[Tried] = []
    numbers = range(asked.first, asked.first + asked.simulated)
    with sweep(numbers, lambda number: fly(number, "sim"), JOBS, what="flights") as outcomes:
        for number, outcome in outcomes:
            _take_down(tried, number, outcome)
    for number in range(asked.first, asked.first + asked.processes):
        _take_down(tried, number, fly(number, "process"))
    _say(tried)


def _tell(sentence: str) -> None:
    sys.stdout.write(sentence + "\n")
    sys.stdout.flush()


def _take_down(tried: list[Tried], number: int, outcome: Any) -> None:
    if not isinstance(outcome, Tried):
        _tell(f"flight {number}: {outcome}")
        return
    tried.append(outcome)
    if not outcome.whole:
        got = f"{outcome.reproduced} of {outcome.expected}"
        _tell(f"flight {number} ({outcome.backend}, {outcome.kind}): {got}: {outcome.why[:2]}")


def _say(tried: list[Tried]) -> None:
    by_kind: dict[tuple[str, str], list[Tried]] = defaultdict(list)
    for one in tried:
        by_kind[one.backend, one.kind].append(one)
    _tell("| flights | records | all chains | chains | blocks | inputs (median) | s (median, maximum) |")
    _tell("|---|---|---|---|---|---|---|")
    for (backend, kind), of_kind in sorted(by_kind.items()):
        whole = f"{sum(one.whole for one in of_kind)}/{len(of_kind)}"
        chains = f"{sum(one.reproduced for one in of_kind)}/{sum(one.expected for one in of_kind)}"
        took = [one.took_s for one in of_kind]
        times = f"{statistics.median(took):.2f}, {max(took):.2f}"
        inputs = statistics.median(one.inputs for one in of_kind)
        blocks = sum(one.blocks for one in of_kind)
        flights = f"{len(of_kind)} {backend}"
        _tell(f"| {flights} | {kind} | {whole} | {chains} | {blocks} | {inputs:.0f} | {times} |")
    for reason, count in Counter(_kind_of_reason(one.why) for one in tried if not one.whole).most_common():
        _tell(f"{count} x {reason}")


def _kind_of_reason(why: tuple[str, ...]) -> str:
    return why[0][:60] if why else "no reason given"


if __name__ == "__main__":
    main()
