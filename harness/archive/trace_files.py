"""Find the traces of a run, read them, and pack large traces with gzip.

A trace of a process contains every received datagram, so the traces of a large swarm take gigabytes. Packed, they take
about a sixth. The harness packs finished parts during the run (`harness.archive.bounded_file`), and the rest after it.
All readers accept `7.trace.jsonl.gz`, and they accept `7.trace.jsonl` even if a part of it is packed.
"""

from collections.abc import Callable
from pathlib import Path

from harness.archive.bounded_file import BoundedFile, can_free_parts, has_finished_part, pack_whole

SUFFIX = ".trace.jsonl"
PACKED_SUFFIX = f"{SUFFIX}.gz"
MAX_TRACE_BYTES = 256 * 1024 * 1024
"""Maximum size of a trace in bytes. In a swarm of 50 agents without loss, a trace reaches a tenth of this size in 20
minutes.
"""
PACKED_FROM_BYTES = 64 * 1024 * 1024
"""The harness compresses the traces of a run if their total size is at least this number of bytes."""
PACKED_SHARE = 1 / 6
"""Size of a packed trace, as a share of its content."""


def trace_files(agents: Path) -> list[Path]:
    """Return the traces in a directory, in the order of the agent IDs in their names."""
    plain = {path.name: path for path in agents.glob(f"*{SUFFIX}") if path.exists()}
    packed = {path.name.removesuffix(".gz"): path for path in agents.glob(f"*{PACKED_SUFFIX}")}
    return [path for _, path in sorted((packed | plain).items(), key=lambda item: (len(item[0]), item[0]))]


def trace_file(agents: Path, agent_id: int) -> Path:
    """Return the path of an agent's trace. If the agent has no trace, return the path for an uncompressed trace."""
    plain, packed = agents / f"{agent_id}{SUFFIX}", agents / f"{agent_id}{PACKED_SUFFIX}"
    return packed if packed.exists() and not plain.exists() else plain


def is_packed(path: Path) -> bool:
    return path.name.endswith(".gz")


def has_rest(path: Path) -> bool:
    """Return true if the file at `path` contains only the packed parts of a trace, and a second, plain file contains
    the rest of the trace.
    """
    return is_packed(path) and path.with_name(path.name.removesuffix(".gz")).exists()


def open_trace(path: Path) -> BoundedFile:
    """Open a trace for reading, compressed or not. Raises OSError if `path` is not a regular file."""
    return BoundedFile(path, MAX_TRACE_BYTES)


def packable_traces(agents: Path) -> list[Path]:
    """Return the traces of an active run that have a part that `pack_parts` can pack. The list is empty while all
    traces together are small. It is also empty if the file system cannot free a part of a file.
    """
    traces = _plain_traces(agents)
    if _are_small(traces) or not can_free_parts(agents):
        return []
    return [path for path in traces if has_finished_part(path)]


def pack_traces(agents: Path, report_progress: Callable[[str], None]) -> None:
    """Pack the traces of an ended run if their total size is large.

    Ctrl-C ends the compression, and the remaining traces stay uncompressed. A trace also stays uncompressed if the disk
    is full.
    """
    traces = _plain_traces(agents)
    if _are_small(traces):
        return
    for number, path in enumerate(traces, 1):
        try:
            report_progress(f"packing trace {number} of {len(traces)}")
            pack_whole(path)
        except OSError:
            continue
        except KeyboardInterrupt:
            return


def _plain_traces(agents: Path) -> list[Path]:
    """Return the path of each uncompressed trace once. If agents run in containers, this is the path of the symbolic
    link to the trace.
    """
    traces = [path for path in agents.rglob(f"*{SUFFIX}") if path.exists()]
    linked = {path.resolve() for path in traces if path.is_symlink()}
    return sorted(path for path in traces if path.is_symlink() or path.resolve() not in linked)


def _are_small(traces: list[Path]) -> bool:
    return sum(path.stat().st_size for path in traces) < PACKED_FROM_BYTES
