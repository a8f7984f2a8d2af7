"""Damaged files through all that reads what came home: no traceback, bounded, and what is dropped is named."""

import gzip
import json
import random
import resource
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.record import RogueInjection
from harness.archive.trace_lines import read_lines
from harness.errors import HarnessError
from harness.field.adapters import bring_in
from harness.field.adapters.comma_separated import CommaSeparated
from harness.field.adapters.record import FILE, ImportRecord
from harness.field.adapters.rosbag import RosBag
from harness.field.homecoming import Homecoming, sort_out
from harness.field.replay import Player, open_record
from tests.harness.field.flights import flown
from tests.harness.field.mutations import damaged
from tests.harness.field.recordings import of_run, write_bag1, write_bag2, write_csv

MOST_S = 20.0
MOST_GROWTH_BYTES = 512 * 1024 * 1024
LONGEST_SENTENCE = 2000
_TRACE_LINES = 24
_FRAMES = 30


class FailedError(AssertionError):
    """A reader did what none may do with any file; `number` is that of the file."""

    number = 0


@dataclass
class Outcome:
    """How often a reader used a file wholly, partly, or not at all."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, reader: str, how: str) -> None:
        self.counts[reader, how] += 1


def corpus(directory: Path) -> Path:
    """Valid files of each kind, small, under `directory`/files, and the run that they are of."""
    run = flown(directory / "run", duration_s=150, capture=True)
    for trace in (run / "agents").glob("*.trace.jsonl"):
        trace.write_bytes(b"".join(trace.read_bytes().splitlines(keepends=True)[:_TRACE_LINES]))
    for capture in (run / "capture").iterdir():
        capture.write_bytes(_first_blocks(capture.read_bytes()))
    files = directory / "files"
    files.mkdir()
    for path in (*(run / "agents").iterdir(), *(run / "capture").iterdir()):
        if path.name.startswith(("1.", "2.")):
            shutil.copy(path, files)
    shutil.copy(run / "run.json", files)
    trace = (files / "1.trace.jsonl").read_bytes()
    (files / "1.trace.jsonl.gz").write_bytes(gzip.compress(trace))
    (files / "two_flights.trace.jsonl").write_bytes(trace + trace.replace(b'"epoch_us":0', b'"epoch_us":99'))
    (files / "old.trace.jsonl").write_bytes(_version_1(trace))
    write_csv(files / "all.csv", of_run(run, ("trace", "export", "sent")))
    write_csv(files / "heard.csv", islice(of_run(run, ("sent",)), _FRAMES))
    for compression in (None, "BZ2", "LZ4"):
        write_bag1(files / f"{compression}.bag", of_run(run, ("trace", "export", "sent")), compression)
    for storage in ("sqlite3", "mcap"):
        bag = write_bag2(directory / storage, of_run(run, ("trace", "sent")), storage)
        for path in bag.iterdir():
            if path.name != "metadata.yaml":
                shutil.copy(path, files / f"bag{path.suffix}")
    (files / "events.jsonl").write_text(
        "".join(
            json.dumps({"schema": "ucp-events/1", "agent_id": 1, "time_us": at, "event_id": 3, "data": "YWJj"}) + "\n"
            for at in range(20)
        )
    )
    return files


def _first_blocks(capture: bytes) -> bytes:
    position = 0
    for _ in range(_FRAMES):
        if position + 8 > len(capture):
            break
        position += int.from_bytes(capture[position + 4 : position + 8], "little")
    return capture[:position]


def _version_1(trace: bytes) -> bytes:
    lines = [json.loads(line) for line in trace.splitlines()]
    lines[0]["schema"] = "ucp-trace/1"
    del lines[0]["initial_data"]
    for line in lines:
        line.pop("input", None)
        for sent in line.get("sent", ()):
            del sent["datagram"]
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)


def fuzz(directory: Path, seed: int, first: int, files: int, outcome: Outcome) -> Iterator[int]:
    """Give that many damaged files, from number `first` of the seed on, to every reader. Raises FailedError."""
    sources = sorted(corpus(directory).iterdir())
    run = directory / "run"
    for number in range(first, first + files):
        chance = random.Random(f"{seed} {number}")
        source = chance.choice(sources)
        content = damaged(source.read_bytes(), chance)
        case = directory / "case"
        case.mkdir(exist_ok=True)
        path = case / source.name
        path.write_bytes(content)
        try:
            with bounded():
                _read(path, run, directory, chance, outcome)
        except Exception as error:
            kept = directory / f"failed-{seed}-{number}-{source.name}"
            shutil.copy(path, kept)
            failed = FailedError(f"{kept}: {type(error).__name__}: {str(error)[:500]}")
            failed.number = number
            raise failed from error
        path.unlink()
        yield number


@contextmanager
def bounded() -> Iterator[None]:
    """Raises FailedError if it takes too long, or too much memory."""

    def too_long(signal_number: int, frame: FrameType | None) -> None:
        raise FailedError(f"took more than {MOST_S} s")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    former = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, MOST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    if grown > MOST_GROWTH_BYTES:
        raise FailedError(f"took {grown >> 20} MiB more memory")


def _read(path: Path, run: Path, directory: Path, chance: random.Random, outcome: Outcome) -> None:
    homecoming = sort_out([path])
    _named(path, homecoming, outcome)
    if chance.random() < 0.3:
        _among_others(path, run, outcome)
    if _import(path, directory / "out", outcome) and chance.random() < 0.1:
        _check(directory / "out", outcome)
    if path.name.endswith(".trace.jsonl"):
        _replay(path, outcome)
    place = _in_the_run(path, run)
    if place is not None and chance.random() < 0.3:
        _archive(path, place, run, outcome)


def _named(path: Path, homecoming: Homecoming, outcome: Outcome) -> None:
    """Whatever is not used is said."""
    for sentence in homecoming.sentences():
        _sound(sentence)
    dropped = bool(homecoming.left_out)
    if not homecoming.flights:
        _require(dropped, "nothing is used, and nobody says why")
        outcome.add(f"sort_out {path.suffix}", "nothing usable")
        return
    outcome.add(f"sort_out {path.suffix}", "used in part" if dropped else "used")
    if not dropped and path.suffix == ".jsonl":
        lines = [line for line in path.read_bytes().removeprefix(b"\xef\xbb\xbf").split(b"\n") if line.strip()]
        used = sum(
            len(trace.runs) + len(trace.asides) + len(trace.starts) + 1
            for flight in homecoming.flights
            for trace in flight.traces.values()
        ) + sum(len(events) for flight in homecoming.flights for events in flight.logged.values())
        _require(used >= len(lines), f"{len(lines) - used} lines are not used, and nobody says so")


def _among_others(path: Path, run: Path, outcome: Outcome) -> None:
    """A damaged file takes nothing away from the sound ones beside it."""
    homecoming = sort_out([run, path])
    for sentence in homecoming.sentences():
        _sound(sentence)
    flight = homecoming.largest()
    _require({1, 2, 3} <= {*flight.traces} & {*flight.exports} & {*flight.captures}, "a sound file is not used")
    outcome.add("among others", "used in part" if homecoming.left_out else "used")


def _check(out: Path, outcome: Outcome) -> None:
    """What was imported is judged, or not: without a traceback."""
    try:
        result = checker.check(checker.gather(RunArchive(out)))
    except HarnessError as error:  # captures alone are not judged
        _sound(str(error))
        outcome.add("check", "nothing usable")
        return
    for sentence in result.errors:
        _sound(sentence)
    outcome.add("check", "bad" if result.bad else "not bad")


def _import(path: Path, out: Path, outcome: Outcome) -> bool:
    """Whether anything came of it."""
    shutil.rmtree(out, ignore_errors=True)
    try:
        record = bring_in([path], [CommaSeparated(), RosBag()], out)
    except HarnessError as error:
        _sound(str(error))
        _require(not out.exists(), "nothing is used, and yet there is a directory")
        outcome.add(f"import {path.suffix}", "nothing usable")
        return False
    for remark in (*record.left_out, *record.remarks):
        _sound(remark.sentence)
    ImportRecord.model_validate_json((out / FILE).read_bytes())
    again = sort_out([out])
    imported = {(len(trace.runs), len(trace.asides)) for flight in again.flights for trace in flight.traces.values()}
    runs = sum(agent.handler_runs for flight in record.flights for agent in flight.agents.values())
    _require(sum(count for count, _ in imported) <= runs, "more is read of an import than was written")
    outcome.add(f"import {path.suffix}", "used in part" if record.left_out else "used")
    return True


def _replay(path: Path, outcome: Outcome) -> None:
    try:
        record = open_record(path)
        found = Player(record, None).to_end()
    except HarnessError as error:
        _sound(str(error))
        outcome.add("replay", "nothing usable")
        return
    for sentence in record.problems:
        _sound(sentence)
    outcome.add("replay", "differs" if found.deviations else "no difference")


def _in_the_run(path: Path, run: Path) -> Path | None:
    place = run / "agents" / path.name
    return place if place.exists() else run / path.name if path.name == "run.json" else None


def _archive(path: Path, place: Path, run: Path, outcome: Outcome) -> None:
    """The archive's own readers, which all other commands stand on, of a run of which one file is damaged."""
    whole = place.read_bytes()
    try:
        shutil.copy(path, place)
        archive = RunArchive(run)
        sentences = [*archive.problems, *archive.gaps]
        list(archive.injected(RogueInjection))
        archive.network([1, 2, 3])
        archive.tracks([1, 2, 3])
        for agent in (1, 2, 3):
            _lines(run / "agents" / f"{agent}.trace.jsonl")
    finally:
        place.write_bytes(whole)
    for sentence in sentences:
        _sound(sentence)
    outcome.add("archive", "problems told" if sentences else "used")


def _lines(path: Path) -> None:
    try:
        for line in read_lines(path):
            line.parsed()
    except HarnessError as error:
        _sound(str(error))


def _sound(sentence: str) -> None:
    _require(len(sentence) < LONGEST_SENTENCE, f"a sentence of {len(sentence)} characters: {sentence[:200]}")
    _require("\n" not in sentence, f"more than a sentence: {sentence[:200]}")
    _require("Traceback" not in sentence, f"a traceback: {sentence[:200]}")


def _require(holds: Any, otherwise: str) -> None:
    if not holds:
        raise FailedError(otherwise)
