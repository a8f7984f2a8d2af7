"""Find the traces of a run, read them, and compress large traces with gzip.

A trace of a process contains every received datagram, so the traces of a large swarm take gigabytes. After the run, the
harness compresses them to about a sixth of this size. It does not compress them earlier, because agents must be able to
append lines, and a killed agent must leave all of its lines. All readers accept both `7.trace.jsonl` and
`7.trace.jsonl.gz`.
"""

import contextlib
import zlib
from collections.abc import Callable
from pathlib import Path

from harness.archive.bounded_file import BoundedFile
from ucp.plain_file import open_plain_file

SUFFIX = ".trace.jsonl"
PACKED_SUFFIX = f"{SUFFIX}.gz"
MAX_TRACE_BYTES = 256 * 1024 * 1024
"""Maximum size of a trace in bytes. In a swarm of 50 agents without loss, a trace reaches a tenth of it in 20
minutes.
"""
PACKED_FROM_BYTES = 64 * 1024 * 1024
"""Size of all traces of a run together, in bytes, from which they are compressed."""
PACKED_SHARE = 1 / 6
"""Size of a compressed trace, as a share of its original size."""
_LEVEL = 1
"""The compression level of gzip. Higher levels take three times as long and reduce the size by only a tenth."""
_CHUNK_BYTES = 1024 * 1024


def trace_files(agents: Path) -> list[Path]:
    """Return the traces in a directory, in the order of the agent IDs in their names."""
    plain = {path.name: path for path in agents.glob(f"*{SUFFIX}") if path.exists()}
    packed = {path.name.removesuffix(".gz"): path for path in agents.glob(f"*{PACKED_SUFFIX}")}
    return [path for _, path in sorted((packed | plain).items(), key=lambda item: (len(item[0]), item[0]))]


def trace_file(agents: Path, agent_id: int) -> Path:
    """Return the path of an agent's trace. If the agent has no trace, return the path that an uncompressed trace would
    have.
    """
    plain, packed = agents / f"{agent_id}{SUFFIX}", agents / f"{agent_id}{PACKED_SUFFIX}"
    return packed if packed.exists() and not plain.exists() else plain


def is_packed(path: Path) -> bool:
    return path.name.endswith(".gz")


def open_trace(path: Path) -> BoundedFile:
    """Open a trace for reading, compressed or not. Raises OSError if `path` is not a regular file."""
    return BoundedFile(path, MAX_TRACE_BYTES)


def pack_traces(agents: Path, report_progress: Callable[[str], None]) -> None:
    """Compress the traces of an ended run with gzip if their total size is large.

    Ctrl-C ends the compression, and the remaining traces stay uncompressed. A trace also stays uncompressed if the disk
    is full.
    """
    plain = sorted(agents.rglob(f"*{SUFFIX}"))
    if sum(path.stat().st_size for path in plain) < PACKED_FROM_BYTES:
        return
    for number, path in enumerate(plain, 1):
        packed = path.with_name(f".{path.name}.gz.tmp")
        try:
            report_progress(f"packing trace {number} of {len(plain)}")
            _pack(path, packed)
            packed.rename(path.with_name(f"{path.name}.gz"))
            path.unlink()
        except (OSError, KeyboardInterrupt) as error:
            with contextlib.suppress(OSError):
                packed.unlink(missing_ok=True)
            if isinstance(error, KeyboardInterrupt):
                return


def _pack(path: Path, packed: Path) -> None:
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    with open_plain_file(path) as source, packed.open("wb") as target:
        while data := source.read(_CHUNK_BYTES):
            target.write(packer.compress(data))
        target.write(packer.flush())
