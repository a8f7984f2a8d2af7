"""Damage the records of correct agents in many ways, and count the commands' false accusations.

    python -m benchmarks.field_damage [--simulated N] [--processes N] [--containers N] [--first NUMBER]
                                      [--only KIND]

Each flight is damaged once in each way of `DAMAGES`. `reconstruct`, `replay`, `check` and `consolidate` then read the
damaged files. The agents are correct, so each accusation is false. The benchmark prints each accusation and each
traceback with the number of its flight. The exit status is 1 if there is an accusation or a traceback.
"""

import argparse
import asyncio
import base64
import gzip
import json
import re
import shutil
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from harness.archive.archive import RunArchive
from harness.archive.directory import RunDirectory
from harness.archive.exports import Export, read_export
from harness.backend_names import BackendName
from harness.checker import check, gather
from harness.errors import HarnessError
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import consolidate
from harness.field.ingest import ingest_files
from harness.field.reconstruct import reconstruct
from harness.field.replay import RecordPlayer, open_records
from harness.field.replay.field_evidence import field_evidence
from harness.play.backends import BACKENDS
from harness.play.mission import play_on
from harness.play.progress import SilentProgress
from harness.run.parallel import FailedTask, sweep
from harness.scenario import Scenario
from ucp.quirks import QUIRKS

JOBS = 2
BLOCK_BYTES = 4096


class NotPossibleError(Exception):
    """An error: the files of this flight cannot be damaged in this way."""


# Damage

Damage = Callable[[Path, Random], None]
"""A function that damages the files in a directory."""


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def _a_trace(home: Path, draw: Random, least_lines: int = 20) -> Path:
    traces = [path for path in sorted(home.glob("*.trace.jsonl")) if path.read_bytes().count(b"\n") >= least_lines]
    if not traces:
        raise NotPossibleError
    return draw.choice(traces)


def nothing(home: Path, draw: Random) -> None:
    """Leave the files as they are."""


def cut_line_out(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    lines = _lines(path)
    del lines[draw.randrange(1, len(lines))]
    path.write_bytes(b"".join(lines))


def cut_lines_out_of_each_trace(home: Path, draw: Random) -> None:
    for path in sorted(home.glob("*.trace.jsonl")):
        lines = _lines(path)
        for _ in range(min(3, len(lines) - 1)):
            del lines[draw.randrange(1, len(lines))]
        path.write_bytes(b"".join(lines))


def zero_line(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    lines = _lines(path)
    number = draw.randrange(1, len(lines))
    lines[number] = b"\0" * (len(lines[number]) - 1) + b"\n"
    path.write_bytes(b"".join(lines))


def cut_tail(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * draw.uniform(0.3, 0.98))])


def cut_head(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    data = path.read_bytes()
    path.write_bytes(data[int(len(data) * draw.uniform(0.02, 0.5)) :])


def flip_byte(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    data = bytearray(path.read_bytes())
    data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    path.write_bytes(data)


def swap_lines(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    lines = _lines(path)
    number = draw.randrange(1, len(lines) - 1)
    lines[number], lines[number + 1] = lines[number + 1], lines[number]
    path.write_bytes(b"".join(lines))


def repeat_lines(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    lines = _lines(path)
    start = draw.randrange(1, len(lines))
    end = min(len(lines), start + draw.choice([1, 1, 5, 50]))
    path.write_bytes(b"".join([*lines[:end], *lines[start:end], *lines[end:]]))


def _a_block(data: bytes, draw: Random) -> tuple[int, int]:
    blocks = len(data) // BLOCK_BYTES
    if not blocks:
        raise NotPossibleError
    begin = BLOCK_BYTES * draw.randrange(blocks)
    return begin, begin + BLOCK_BYTES


def zero_block(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    data = path.read_bytes()
    begin, end = _a_block(data, draw)
    path.write_bytes(data[:begin] + bytes(BLOCK_BYTES) + data[end:])


def cut_block_out(home: Path, draw: Random) -> None:
    path = _a_trace(home, draw)
    data = path.read_bytes()
    begin, end = _a_block(data, draw)
    path.write_bytes(data[:begin] + data[end:])


def fill_disk(home: Path, draw: Random) -> None:
    """Remove a long part of a file, which begins within one line and ends within another line."""
    path = _a_trace(home, draw)
    lines = _lines(path)
    begin = draw.randrange(1, len(lines) // 2)
    end = draw.randrange(begin + 1, min(len(lines), begin + len(lines) // 4))
    path.write_bytes(b"".join([*lines[:begin], lines[begin][: len(lines[begin]) // 2], *lines[end:]]))


def lose_trace(home: Path, draw: Random) -> None:
    _a_trace(home, draw).unlink()


def lose_export(home: Path, draw: Random) -> None:
    draw.choice(sorted(home.glob("*.chain.json"))).unlink()


def lose_agent(home: Path, draw: Random) -> None:
    agent = _a_trace(home, draw).name.partition(".")[0]
    for path in home.glob(f"{agent}.*"):
        path.unlink()


def lose_incarnation(home: Path, draw: Random) -> None:
    """Remove the part of a trace between two restarts."""
    for path in sorted(home.glob("*.trace.jsonl")):
        lines = _lines(path)
        starts = [number for number, line in enumerate(lines) if b'"schema"' in line]
        if len(starts) > 1:
            lost = draw.randrange(len(starts))
            del lines[starts[lost] : [*starts, len(lines)][lost + 1]]
            path.write_bytes(b"".join(lines))
            return
    raise NotPossibleError


def _keep(home: Path, *suffixes: str) -> None:
    if ".pcapng" in suffixes and not [*home.glob("*.pcapng")]:
        raise NotPossibleError
    for path in home.iterdir():
        if not path.name.endswith(suffixes):
            path.unlink()


def captures_only(home: Path, draw: Random) -> None:
    _keep(home, ".pcapng")


def exports_only(home: Path, draw: Random) -> None:
    _keep(home, ".chain.json")


def exports_and_captures_only(home: Path, draw: Random) -> None:
    _keep(home, ".chain.json", ".pcapng")


def cut_export(home: Path, draw: Random) -> None:
    path = draw.choice(sorted(home.glob("*.chain.json")))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * draw.uniform(0.1, 0.95))])


def cut_capture(home: Path, draw: Random) -> None:
    """Keep only exports and packet captures, and cut one capture short."""
    _keep(home, ".chain.json", ".pcapng")
    path = draw.choice(sorted(home.glob("*.pcapng")))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * draw.uniform(0.3, 0.95))])


def _two_traces(home: Path, draw: Random) -> list[Path]:
    traces = sorted(home.glob("*.trace.jsonl"))
    if len(traces) < 2:
        raise NotPossibleError
    return draw.sample(traces, 2)


def swap_names_of_traces(home: Path, draw: Random) -> None:
    """Give the trace of one agent the file name of another agent, and the reverse."""
    one, other = _two_traces(home, draw)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)


def add_cut_copy(home: Path, draw: Random) -> None:
    """Add a copy of a trace that ends earlier."""
    path = _a_trace(home, draw)
    data = path.read_bytes()
    (home / "backup.jsonl").write_bytes(data[: int(len(data) * draw.uniform(0.3, 0.98))])


def add_other_mission(home: Path, draw: Random) -> None:
    """Add the trace of an agent from another mission with the same roster."""
    path = _a_trace(home, draw)
    header, *lines = _lines(path)
    document = json.loads(header)
    document["initial_data"] = base64.b64encode(b"another mission").decode()
    (home / "hover-test.jsonl").write_bytes(b"".join([json.dumps(document).encode() + b"\n", *lines]))


def interleave_traces(home: Path, draw: Random) -> None:
    """Write the lines of two agents alternately into one file, as two programs with one log do."""
    one, other = _two_traces(home, draw)
    lines = [_lines(one), _lines(other)]
    mixed = []
    while any(lines):
        of_agent = draw.choice([each for each in lines if each])
        mixed.append(of_agent.pop(0))
    one.write_bytes(b"".join(mixed))
    other.unlink()


def set_clock_back(home: Path, draw: Random) -> None:
    """Decrease all times of a trace from one line on, as if GPS or NTP had set the clock back."""
    _set_clock(home, draw, -1)


def set_clock_forward(home: Path, draw: Random) -> None:
    """Increase all times of a trace from one line on, as if GPS or NTP had set the clock forward."""
    _set_clock(home, draw, 1)


def _set_clock(home: Path, draw: Random, sign: int) -> None:
    path = _a_trace(home, draw)
    lines = _lines(path)
    start, by_s = draw.randrange(1, len(lines)), sign * draw.uniform(0.5, 30.0)
    for number in range(start, len(lines)):
        entry = json.loads(lines[number])
        if "t" in entry:
            entry["t"] = round(entry["t"] + by_s, 6)
            lines[number] = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
    path.write_bytes(b"".join(lines))


def end_lines_as_windows(home: Path, draw: Random) -> None:
    """End all lines of the text files with CR LF."""
    for path in [*home.glob("*.trace.jsonl"), *home.glob("*.chain.json")]:
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))


def pack_half_a_line(home: Path, draw: Random) -> None:
    """Pack a trace with gzip in two parts. The second part begins within a line."""
    path = _a_trace(home, draw)
    lines = _lines(path)
    last = lines[-1][: len(lines[-1]) // 2]
    middle = draw.randrange(1, len(lines) - 1)
    packed = gzip.compress(b"".join(lines[:middle])) + gzip.compress(b"".join([*lines[middle:-1], last]))
    path.with_name(f"{path.name}.gz").write_bytes(packed)
    path.unlink()


def cut_packed_trace(home: Path, draw: Random) -> None:
    """Pack a trace with gzip, and cut off the end of the packed file."""
    path = _a_trace(home, draw)
    packed = gzip.compress(path.read_bytes())
    path.with_name(f"{path.name}.gz").write_bytes(packed[: int(len(packed) * draw.uniform(0.3, 0.99))])
    path.unlink()


DAMAGES: dict[str, Damage] = {
    "undamaged": nothing,
    "line cut out": cut_line_out,
    "three lines cut out of each trace": cut_lines_out_of_each_trace,
    "line zeroed": zero_line,
    "tail cut": cut_tail,
    "head cut": cut_head,
    "byte flipped": flip_byte,
    "two lines swapped": swap_lines,
    "lines repeated": repeat_lines,
    "4 KiB zeroed": zero_block,
    "4 KiB cut out": cut_block_out,
    "disk full in the middle": fill_disk,
    "trace missing": lose_trace,
    "export missing": lose_export,
    "agent missing": lose_agent,
    "incarnation missing": lose_incarnation,
    "captures only": captures_only,
    "exports only": exports_only,
    "exports and captures only": exports_and_captures_only,
    "export cut": cut_export,
    "capture cut, no traces": cut_capture,
    "names of two traces swapped": swap_names_of_traces,
    "second, cut copy of a trace": add_cut_copy,
    "trace of another mission": add_other_mission,
    "lines of two traces interleaved": interleave_traces,
    "clock set back": set_clock_back,
    "clock set forward": set_clock_forward,
    "lines end with CR LF": end_lines_as_windows,
    "packed trace with half a last line": pack_half_a_line,
    "packed trace cut": cut_packed_trace,
}


# Flights


def scenario(number: int, backend: BackendName, quirk: str | None = None) -> Scenario:
    """Return the scenario of a flight. It has loss and faults, and either clocks that drift or packet captures."""
    draw = Random(f"field damage {number}")
    agents = draw.choice([3, 4, 5, 6])
    duration_s = 300.0
    struck, at_s = draw.randint(1, agents), draw.randint(60, 150)
    back_s = at_s + draw.randint(10, 90)
    faults: list[list[dict[str, Any]]] = [
        [],
        [{"at_s": at_s, "kill": [struck]}],
        [{"at_s": at_s, "kill": [struck]}, {"at_s": back_s, "restart": [struck]}],
        [{"at_s": at_s, "reboot": [struck], "down_s": 10, "disk": "kept"}],
        [{"at_s": at_s, "reboot": [struck], "down_s": 10, "disk": "lost"}],
        [{"at_s": at_s, "pause": [struck]}, {"at_s": back_s, "resume": [struck]}],
    ]
    timeline = draw.choice(faults)
    if draw.random() < 0.5:
        apart = draw.sample(range(1, agents + 1), draw.randint(1, agents - 1))
        timeline = [{"at_s": 30.5, "partition": [sorted(apart)], "for_s": 100}, *timeline]
    capture = number % 2 == 1
    document: dict[str, Any] = {
        "name": f"damaged flight {number}",
        "agents": agents,
        "duration_s": duration_s,
        "network": {"loss": draw.choice([0.0, 0.1, 0.25, 0.4])},
        "events": {"source": "random", "mean_s": draw.choice([4.0, 8.0, 15.0])},
        "timeline": timeline,
        "capture": capture,
        "final_reconcile": draw.random() < 0.7,
    }
    if draw.random() < 0.3:
        document["settings"] = draw.choice(
            [{"vote_names_chain": True}, {"finalize_gap_s": 0}, {"max_block_bytes": 512}]
        )
    if backend != "sim":
        document |= {"speedup": 20, "vehicles": {"kind": "none"}, "settle": {"limit_s": 300}}
    if backend == "docker":
        document["docker"] = {"image_from_host": True}  # no registry is needed
    if not capture or backend != "sim":
        document["clocks"] = {
            agent: {"offset_s": draw.uniform(0, 100), "drift": draw.choice([1e-5, 1e-3, 1e-2]) * draw.uniform(-1, 1)}
            for agent in range(1, agents + 1)
        }
    if quirk is not None:
        document["quirks"] = {quirk: {"agents": [struck]} if not QUIRKS[quirk].chance else {str(struck): 0.5}}
    return Scenario.model_validate(document)


def bring_home(asked: Scenario, number: int, backend: BackendName, run: Path, home: Path) -> dict[int, Export]:
    """Play a flight and copy the files of its vehicles to `home`. Return the exports."""
    opening = BACKENDS[backend].open(asked, number, RunDirectory(run), SilentProgress(), asyncio.Event())
    asyncio.run(play_on(opening, asked))
    home.mkdir()
    for path in [*(run / "agents").glob("*.trace.jsonl"), *(run / "agents").glob("*.chain.json")]:
        shutil.copy(path, home)
    for path in (run / "capture").glob("*.pcapng") if (run / "capture").is_dir() else ():
        shutil.copy(path, home)
    return {export.agent_id: export for export in map(read_export, home.glob("*.chain.json"))}


# The commands

ACCUSATION = re.compile(
    r"deviates|behaves (only )?as with|did not react|^agent \d+ should have|does not do what|"
    r"expired too early(?!.*as if the clock had been set back)",
    re.IGNORECASE,
)
"""Matches an output of `reconstruct` that blames an agent."""


@dataclass(frozen=True)
class Undamaged:
    """The facts about a flight: the undamaged exports, and the verdicts on the undamaged files."""

    chains: dict[int, Export]
    wrong: tuple[str, ...]


@dataclass
class Concluded:
    """The conclusions of all commands from one set of files."""

    damage: str
    chains: int = 0
    """Number of agents with a trace or an export in the damaged files."""
    reproduced: int = 0
    differs: str | None = None
    """The first difference between the simulation and the records, if any."""
    unusable: bool = False
    reasons: list[str] = field(default_factory=list)
    accusations: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    seconds: float = 0.0


def run_reconstruct(home: Path, concluded: Concluded, whole: Undamaged) -> None:
    made = reconstruct(ingest_files([home]).largest(), "again")
    concluded.chains = len(made.agents)
    concluded.reproduced = len(made.reproduced)
    concluded.differs = made.difference.sentence if made.difference else None
    concluded.reasons = [f"agent {agent.agent_id} {agent.why}" for agent in made.agents if agent.why]
    for sentence in [*concluded.reasons, *made.remarks]:
        if ACCUSATION.search(sentence) and not sentence.startswith("either "):
            concluded.accusations.append(f"reconstruct: {sentence}")
    claimed: dict[str, str] = made.document["expect"].get("chains", {})
    if {*map(int, claimed)} != {*made.reproduced} & {*made.simulated.evidence.exports}:
        concluded.accusations.append("reconstruct: the scenario expects other chains than those that it reproduces")
    for agent, top in claimed.items():
        if (export := whole.chains.get(int(agent))) is not None and export.top_chain_hash != top:
            concluded.accusations.append(f"reconstruct: claims the chain of agent {agent}, which differs")


def run_replay(home: Path, concluded: Concluded, whole: Undamaged) -> None:
    for record in open_records(home):
        for deviation in RecordPlayer(record).to_end().deviations:
            sentence = deviation.sentence(lambda block: block[:8])
            concluded.accusations.append(f"replay: agent {record.agent_id}: {sentence}")


def run_check(home: Path, concluded: Concluded, whole: Undamaged) -> None:
    evidence = gather(RunArchive(home))
    if evidence.traces:
        evidence = field_evidence(evidence, ingest_files([home]).largest())
    result = check(evidence)
    for key in result.wrong:
        if key in whole.wrong:
            continue
        judgement = result.judgements[key]
        detail = judgement.evidence[0].detail if judgement.evidence else ""
        concluded.accusations.append(f"check: {key} {judgement.verdict}: {judgement.reason}: {detail}")


def run_consolidate(home: Path, concluded: Concluded, whole: Undamaged) -> None:
    consolidate(collect_exports([home]))


Command = Callable[[Path, Concluded, Undamaged], None]
COMMANDS: tuple[Command, ...] = (run_reconstruct, run_replay, run_check, run_consolidate)


def conclude(home: Path, damage: str, whole: Undamaged, commands: Sequence[Command] | None = None) -> Concluded:
    """Run the commands (by default all) on the files, and return their conclusions."""
    concluded = Concluded(damage)
    for command in COMMANDS if commands is None else commands:
        try:
            command(home, concluded, whole)
        except HarnessError:
            concluded.unusable |= command is run_reconstruct
        except Exception:  # a traceback is a result of this measurement
            concluded.tracebacks.append(f"{command.__name__}: {traceback.format_exc()}")
    return concluded


def fly(number: int, backend: BackendName, only: str | None = None, quirk: str | None = None) -> list[Concluded]:
    """Play a flight, damage its files in all possible ways, and return the conclusions."""
    asked = scenario(number, backend, quirk)
    found = []
    with TemporaryDirectory(prefix="field-damage-") as kept:
        whole = Path(kept) / "whole"
        chains = bring_home(asked, number, backend, Path(kept) / "run", whole)
        undamaged = Undamaged(chains, check(RunArchive(whole)).wrong)
        for name, damage in DAMAGES.items():
            if only is not None and only not in name:
                continue
            home = Path(kept) / "home"
            shutil.copytree(whole, home)
            try:
                damage(home, Random(f"{number} {name}"))
                began = time.monotonic()
                concluded = conclude(home, name, undamaged)
                concluded.seconds = time.monotonic() - began
                found.append(concluded)
            except NotPossibleError:
                pass
            shutil.rmtree(home)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.field_damage",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--simulated", type=int, default=30, help="number of flights in virtual time")
    parser.add_argument("--processes", type=int, default=0, help="number of flights with processes")
    parser.add_argument("--containers", type=int, default=0, help="number of flights in containers")
    parser.add_argument("--first", type=int, default=0, help="number of the first flight")
    parser.add_argument("--only", help="damage only in ways whose name contains this text")
    asked = parser.parse_args()
    found: list[Concluded] = []
    numbers = range(asked.first, asked.first + asked.simulated)
    with sweep(numbers, lambda number: fly(number, "sim", asked.only), JOBS, what="flights") as outcomes:
        for number, outcome in outcomes:
            _take_down(found, number, outcome)
    in_real_time: tuple[tuple[BackendName, int], ...] = (("process", asked.processes), ("docker", asked.containers))
    for backend, flights in in_real_time:
        for number in range(asked.first, asked.first + flights):
            _take_down(found, number, fly(number, backend, asked.only))
    _show(found)
    return 1 if any(one.accusations or one.tracebacks for one in found) else 0


def _write(sentence: str) -> None:
    sys.stdout.write(sentence + "\n")
    sys.stdout.flush()


def _take_down(found: list[Concluded], number: int, outcome: list[Concluded] | FailedTask) -> None:
    if isinstance(outcome, FailedTask):
        _write(f"flight {number}: {outcome.reason}")
        return
    found += outcome
    for one in outcome:
        where = f"flight {number}, {one.damage}"
        for sentence in [*one.accusations, *one.tracebacks]:
            _write(f"{where}: ✘ {sentence[:600]}")
        for sentence in [*one.reasons, *([one.differs] if one.differs else [])]:
            _write(f"{where}: - {sentence[:300]}")


def _show(found: list[Concluded]) -> None:
    by_damage: dict[str, list[Concluded]] = defaultdict(list)
    for one in found:
        by_damage[one.damage].append(one)
    _write(
        "| damage | files of | chains | reproduced | declared impossible | differing steps | accused | tracebacks | s |"
    )
    _write("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for name in DAMAGES:
        if not (of_kind := by_damage.get(name)):
            continue
        cells = [
            len(of_kind),
            sum(one.chains for one in of_kind),
            sum(one.reproduced for one in of_kind),
            sum(len(one.reasons) for one in of_kind),
            sum(one.differs is not None for one in of_kind),
            sum(bool(one.accusations) for one in of_kind),
            sum(bool(one.tracebacks) for one in of_kind),
        ]
        _write(f"| {name} | {' | '.join(map(str, cells))} | {sum(one.seconds for one in of_kind) / len(of_kind):.2f} |")


if __name__ == "__main__":
    sys.exit(main())
