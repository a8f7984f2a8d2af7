"""Fuzz target: a trace that gzip has compressed."""

import gzip
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.targets.home import came_home


def run(data: bytes) -> None:
    came_home("1.trace.jsonl.gz", data)


def seeds(flown: Path) -> Iterator[bytes]:
    lines = (flown / "agents" / "1.trace.jsonl").read_bytes().splitlines(keepends=True)
    yield gzip.compress(b"".join(lines[:6]), mtime=0)
    yield b"".join(gzip.compress(line, mtime=0) for line in lines[:3])
