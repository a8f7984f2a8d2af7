"""Fuzz target: files of a real flight, and all code that reads them.

The code raises no unexpected exception, and reports each unused file. The target ingests a file alone and together with
undamaged files. It imports the file, replays the file if it is a trace, and reads it from the archive of its run. The
target performs the slow steps only with some inputs. The bytes of an input determine this.
"""

import zlib
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.run_record import RogueInjection
from harness.archive.traces import read_trace_lines
from harness.errors import HarnessError
from harness.field.adapters import import_records
from harness.field.adapters.csv_adapter import CsvAdapter
from harness.field.adapters.imported_records import FILE, ImportRecord
from harness.field.adapters.rosbag_adapter import RosBag
from harness.field.ingest import IngestResult, ingest_files
from harness.field.replay import RecordPlayer, open_record
from tests.fuzz.finding import require, sound
from tests.harness.field.flights import flown

TRACE_LINES = 24
FRAMES = 30
DURATION_S = 150.0
_AGENTS = {1, 2, 3}


def run_of_three(directory: Path) -> Path:
    """Play a run with small files: traces and packet captures contain only their beginnings."""
    run = flown(directory, duration_s=DURATION_S, capture=True)
    for trace in (run / "agents").glob("*.trace.jsonl"):
        trace.write_bytes(b"".join(trace.read_bytes().splitlines(keepends=True)[:TRACE_LINES]))
    for capture in (run / "capture").iterdir():
        capture.write_bytes(_first_blocks(capture.read_bytes()))
    return run


def _first_blocks(capture: bytes) -> bytes:
    position = 0
    for _ in range(FRAMES):
        if position + 8 > len(capture):
            break
        position += int.from_bytes(capture[position + 4 : position + 8], "little")
    return capture[:position]


@cache
def _place() -> TemporaryDirectory[str]:
    """Return a temporary directory that exists until the end of the process."""
    return TemporaryDirectory(prefix="fuzz-")


@cache
def sound_run() -> Path:
    """Return the undamaged run of this process. A target replaces one of its files and restores the file afterwards."""
    return run_of_three(Path(_place().name) / "run")


def came_home(name: str, data: bytes) -> None:
    """Ingest and import a file with this name and content."""
    lot = zlib.crc32(data)
    with TemporaryDirectory() as directory:
        path = Path(directory) / name
        path.write_bytes(data)
        _named(path, ingest_files([path]))
        if lot % 4 == 0:
            _among_others(path)
        if _import(path, Path(directory) / "out") and lot % 8 == 0:
            _check(Path(directory) / "out")
        if name.endswith(".trace.jsonl"):
            _replay(path)


def in_its_run(place: str, data: bytes) -> None:
    """Read a run in which the file at the path `place` has this content."""
    run = sound_run()
    path = run / place
    whole = path.read_bytes() if path.exists() else None
    try:
        path.write_bytes(data)
        _archive(run)
    finally:
        if whole is None:
            path.unlink()
        else:
            path.write_bytes(whole)


def _named(path: Path, result: IngestResult) -> None:
    """Check that the report has a sentence for each unused file or line."""
    for sentence in result.sentences():
        sound(sentence)
    dropped = bool(result.left_out)
    if not result.flights:
        require(dropped, "nothing is used, and nobody says why")
        return
    if not dropped and path.suffix == ".jsonl":
        lines = [line for line in path.read_bytes().removeprefix(b"\xef\xbb\xbf").split(b"\n") if line.strip()]
        used = sum(
            len(trace.runs) + len(trace.asides) + len(trace.starts) + 1
            for flight in result.flights
            for trace in flight.traces.values()
        ) + sum(len(events) for flight in result.flights for events in flight.logged.values())
        require(used >= len(lines), f"{len(lines) - used} lines are not used, and nobody says so")


def _among_others(path: Path) -> None:
    """Check that undamaged files are used in spite of a damaged file."""
    result = ingest_files([sound_run(), path])
    for sentence in result.sentences():
        sound(sentence)
    flight = result.largest()
    require({*flight.traces} & {*flight.exports} & {*flight.captures} >= _AGENTS, "a sound file is not used")


def _check(out: Path) -> None:
    """Check that the imported records can be judged, or that the harness refuses them in one sentence."""
    try:
        result = checker.check(checker.gather(RunArchive(out)))
    except HarnessError as error:  # captures alone are not judged
        sound(str(error))
        return
    for sentence in result.errors:
        sound(sentence)


def _import(path: Path, out: Path) -> bool:
    """Import the file. Return true if a part of it could be used."""
    try:
        record = import_records([path], [CsvAdapter(), RosBag()], out)
    except HarnessError as error:
        sound(str(error))
        require(not out.exists(), "nothing is used, and yet there is a directory")
        return False
    for remark in (*record.left_out, *record.remarks):
        sound(remark.sentence)
    ImportRecord.model_validate_json((out / FILE).read_bytes())
    again = ingest_files([out])
    imported = {(len(trace.runs), len(trace.asides)) for flight in again.flights for trace in flight.traces.values()}
    runs = sum(agent.handler_runs for flight in record.flights for agent in flight.agents.values())
    require(sum(count for count, _ in imported) <= runs, "more is read of an import than was written")
    return True


def _replay(path: Path) -> None:
    try:
        record = open_record(path)
        RecordPlayer(record).to_end()
    except HarnessError as error:
        sound(str(error))
        return
    for sentence in record.problems:
        sound(sentence)


def _archive(run: Path) -> None:
    """Read the run with the archive, which all other commands use."""
    archive = RunArchive(run)
    sentences = [*archive.problems, *archive.gaps]
    list(archive.injected(RogueInjection))
    sentences += archive.network(_AGENTS).problems
    sentences += archive.tracks(_AGENTS).problems
    for agent in _AGENTS:
        _lines(run / "agents" / f"{agent}.trace.jsonl")
    for sentence in sentences:
        sound(sentence)


def _lines(path: Path) -> None:
    try:
        for line in read_trace_lines(path):
            line.parse()
    except HarnessError as error:
        sound(str(error))
