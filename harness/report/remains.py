"""What a run left, whole or not: its record, chains and traces, and a sentence for everything that is missing."""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.archive.connectivity import NETWORK_FILE, Connectivity, read_connectivity
from harness.archive.directory import TRACKS_FILE
from harness.archive.exports import RUN_FILE, Exports, export_paths, read_exports
from harness.archive.history import read_traces
from harness.archive.result import DamagedResultError, agent_ids, listing, mapping, read_result
from harness.archive.traces import SUFFIX, Trace
from harness.collector import uncollected
from harness.present.colours import Ink
from harness.report import capture, swarm


@dataclass(frozen=True, slots=True)
class Remains:
    """`result` is what run.json says, or if that cannot be read, nothing but the roster.

    chains_missing: a sentence for each agent without a usable export, and for each export that cannot be used.
    files_missing: likewise for everything else that a whole run leaves.
    """

    run_dir: Path
    result: dict[str, Any]
    exports: Exports
    ink: dict[int, Ink]
    traces: dict[int, Trace]
    whole_traces: bool
    network: Connectivity
    chains_missing: list[str]
    files_missing: list[str]


@uncollected()
def read_remains(run_dir: Path) -> Remains:
    """Raises RunDirectoryError if this is no run directory, or one of another version."""
    result, files_missing = _result(run_dir)
    exports = read_exports(export_paths(run_dir))
    ink = swarm.agent_inks(result, exports.by_agent)
    traces, whole, damaged = read_traces(run_dir / "agents", ink)
    unusable = [error.replace(f"{run_dir}{os.sep}", "") for error in exports.errors]
    network = read_connectivity(run_dir / NETWORK_FILE, ink)
    return Remains(
        run_dir,
        result,
        exports,
        ink,
        traces,
        whole,
        network,
        chains_missing=[*swarm.missing(result, exports), *unusable],
        files_missing=[
            *files_missing,
            *damaged,
            *_cut_off(run_dir),
            *_without_trace(run_dir, result),
            *network.problems,
            *_without_network(run_dir, result),
            *filter(None, [capture.gaps(result)]),
        ],
    )


def _result(run_dir: Path) -> tuple[dict[str, Any], list[str]]:
    """What run.json says. Where it is missing or damaged, the agents are those that left anything."""
    try:
        return read_result(run_dir / RUN_FILE), []
    except DamagedResultError:
        roster = agent_ids(path.name.partition(".")[0] for path in (run_dir / "agents").glob("*.*.json*"))
        if not roster:
            raise
        return {"roster": roster}, [f"{RUN_FILE} is missing or damaged: scenario, verdict and figures are not known"]


def _cut_off(run_dir: Path) -> Iterator[str]:
    """Traces that end in half a line: agents write whole ones."""
    for path in sorted((run_dir / "agents").glob(f"*{SUFFIX}"), key=lambda path: (len(path.name), path.name)):
        with contextlib.suppress(OSError), path.open("rb") as file:
            file.seek(-1, os.SEEK_END)
            if file.read() != b"\n":
                yield f"{path.name}: cut off in mid-line; what is before it is shown"


def _without_trace(run_dir: Path, result: dict[str, Any]) -> Iterator[str]:
    roster = swarm.roster(result)
    without = [agent_id for agent_id in roster if not (run_dir / "agents" / f"{agent_id}{SUFFIX}").is_file()]
    if without and without == roster:
        yield "no agent has left a trace: there is no timeline"
    else:
        yield from (f"agent {agent_id}: no trace, and so no lane in the timeline" for agent_id in without)


def _without_network(run_dir: Path, result: dict[str, Any]) -> Iterator[str]:
    if not (run_dir / NETWORK_FILE).is_file():
        yield f"{NETWORK_FILE} is missing: who could reach whom is not known"
    flew = mapping(result, "vehicles") or listing(result, "scenario", "flight")
    if flew and not (run_dir / TRACKS_FILE).is_file():
        yield f"{TRACKS_FILE} is missing: where the vehicles were is not known"
