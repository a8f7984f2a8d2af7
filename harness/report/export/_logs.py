"""Read the log files of a run's programs. Each line begins with its time.

Agents may use any log format. A line without a time gets the time of the previous line. If the first line has no time,
it gets the start of the mission. Log files do not name their time zone. The reader assumes the zone in which the first
line is nearest to the start of the mission.
"""

import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import chain, islice
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from harness.report.export._samples import Level, LogLine, MissionTime

MAX_BYTES = 32 * 1024 * 1024
MAX_LINE_BYTES = 64 * 1024
MAX_FILES = 3000
_ZONE_STEP_S = 15 * 60
_FURTHEST_ZONE_S = 14 * 3600
_TIME = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d)(?:[.,](\d{1,6}))?\s*")
_WORSE = re.compile(r"\b(error|exception|traceback|fatal|critical|panic)\b", re.IGNORECASE)
_BAD = re.compile(r"\bwarn(ing)?\b", re.IGNORECASE)


def log_files(directory: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name and path of each log file of the run. Log files exist for the network, the rogue node, the agents
    and the vehicles.
    """
    files = chain(directory.glob("*.log"), directory.glob("agents/**/*.log"), directory.glob("vehicles/*/output.log"))
    for path in sorted(islice(files, MAX_FILES)):
        yield str(path.relative_to(directory)).encode("utf-8", "replace").decode(), path


def read_log(source: str, path: Path, time: MissionTime, problems: list[str]) -> Iterator[LogLine]:
    """Yield the lines of a log file. If a part cannot be read, add a sentence to `problems`."""
    at_ns, zone_s = time.at(0.0), None
    try:
        with BoundedFile(path, MAX_BYTES) as file:
            while line := file.readline(MAX_LINE_BYTES):
                text = line.decode("utf-8", "replace").rstrip()
                if timed := _TIME.match(text):
                    wall_s = _seconds(timed)
                    if wall_s is not None and zone_s is None:
                        zone_s = _zone_s(wall_s - time.epoch_ns / 1e9)
                    moment = None if wall_s is None or zone_s is None else time.of_wall(wall_s - zone_s)
                    at_ns = at_ns if moment is None else moment
                    text = text[timed.end() :]
                if text:
                    yield LogLine(at_ns, _level(text), source, text)
            if file.problem:
                problems.append(f"{path}: {file.problem}")
    except OSError as error:
        problems.append(f"{path}: cannot be read: {error.strerror}")


def _zone_s(ahead_s: float) -> float:
    """Return the time zone of a log file as an offset in seconds. The offset is the difference between the first line
    of the log file and the start of the mission. Return infinity if no zone matches, for example in virtual time.
    """
    zone_s = round(ahead_s / _ZONE_STEP_S) * _ZONE_STEP_S
    return zone_s if abs(zone_s) <= _FURTHEST_ZONE_S else math.inf


def _seconds(timed: re.Match[str]) -> float | None:
    """Parse a text as a time in UTC, and return it in seconds since the Unix epoch. Return None if the text is not a
    valid time.
    """
    try:
        whole = datetime.fromisoformat(timed[1]).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None
    return whole + float(f"0.{timed[2] or 0}")


def _level(text: str) -> Level:
    if _WORSE.search(text):
        return "error"
    return "warning" if _BAD.search(text) else "info"
