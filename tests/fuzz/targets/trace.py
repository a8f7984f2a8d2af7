"""Fuzz target: a trace of either version. The writer reproduces its readable part, and all code that uses traces
accepts this part.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.traces import Trace, TraceHeader, parse_line, read_trace, why_not_a_trace
from tests.fuzz.finding import require, sound
from tests.fuzz.targets.home import came_home, in_its_run
from ucp.trace import Entry

NAME = "1.trace.jsonl"


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / NAME
        path.write_bytes(data)
        trace = read_trace(path)
        if trace is None:
            sound(why_not_a_trace(path))
        else:
            for entry in (*trace.runs, *(aside for _, aside in trace.asides)):
                _same_again(entry)
            skimmed = read_trace(path, skim=True)
            require(skimmed is not None and _lines(skimmed) == _lines(trace), "skimmed, it is another")
    came_home(NAME, data)
    in_its_run(f"agents/{NAME}", data)


def _lines(trace: Trace) -> list[str]:
    """Return the skimmed trace as lines. Tests compare these lines and not the objects, because a time that is NaN is
    not equal to itself.
    """
    return [run.to_line() for run in trace.skimmed().runs]


def _same_again(entry: Entry) -> None:
    line = entry.to_line()
    read = parse_line(line.encode("ascii"))
    require(not isinstance(read, TraceHeader) and read.to_line() == line, "a line of a trace is written otherwise")


def seeds(flown: Path) -> Iterator[bytes]:
    whole = (flown / "agents" / NAME).read_bytes()
    yield whole
    yield whole + whole.replace(b'"epoch_us":0', b'"epoch_us":99')
    yield _version_1(whole)


def _version_1(trace: bytes) -> bytes:
    lines = [json.loads(line) for line in trace.splitlines()]
    lines[0]["schema"] = "ucp-trace/1"
    del lines[0]["initial_data"]
    for line in lines:
        line.pop("input", None)
        for sent in line.get("sent", ()):
            del sent["datagram"]
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)
