"""Write the files of a simulated run, and define the interface of an object that records the events of the run."""

import contextlib
import errno
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from harness.archive.bounded_file import pack_parts
from harness.archive.directory import RunDirectory
from harness.archive.trace_files import PACKED_FROM_BYTES, packable_traces
from harness.archive.traces import Trace, TraceHeader
from harness.play.simulation.incarnations import SimulatedIncarnation
from netem.radio import Place
from ucp.agent_files import TraceFile, write_json_atomically
from ucp.trace import SCHEMA, Entry, header_line, in_base64


class TraceCollection:
    """The traces of a simulated run as objects, by agent. The checker reads them instead of files."""

    def __init__(self) -> None:
        self.by_agent: dict[int, Trace] = {}

    def begin(self, incarnation: SimulatedIncarnation) -> None:
        """Begin the trace of an agent, or a new incarnation in it."""
        trace = self.by_agent.get(incarnation.agent.agent_id)
        if trace is None:
            named = header(incarnation)
            named |= {"schema": SCHEMA, "initial_data": in_base64(named["initial_data"])}
            named["secured"] = named["secured"] or None  # as in the file, which omits false
            self.by_agent[incarnation.agent.agent_id] = Trace(TraceHeader(**named))
        else:
            trace.starts.append(len(trace.runs))

    def write(self, agent_id: int, entries: list[Entry]) -> None:
        self.by_agent[agent_id].extend(entries)


class DiskRecorder:
    """A `Recorder` that writes the files of a run directory, and also collects the traces for the checker."""

    tracing = True

    def __init__(self, rundir: RunDirectory, trace_quota: int) -> None:
        """Create the recorder. `trace_quota` is the maximum size of each trace in bytes."""
        self._rundir = rundir
        self._left = defaultdict[int, int](lambda: trace_quota)
        """The number of bytes by which the trace of each agent may still grow."""
        self._written_bytes = 0
        """Total size of all traces, in bytes, when parts of them were last compressed."""
        self._traces: dict[int, TraceFile] = {}
        self._collected = TraceCollection()

    @property
    def traces(self) -> dict[int, Trace] | None:
        """The traces by agent, or None if a trace file lacks a part of the trace."""
        return None if self.problems() else dict(sorted(self._collected.by_agent.items()))

    def begin(self, incarnation: SimulatedIncarnation) -> None:
        agent_id = incarnation.agent.agent_id
        if agent_id not in self._traces:
            self._traces[agent_id] = TraceFile(self._rundir.agents / f"{agent_id}.trace.jsonl")
        self._append(agent_id, header_line(**header(incarnation)))
        self._collected.begin(incarnation)

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """Do nothing, because the file with the agent's blocks also contains the logged events."""

    def write(self, agent_id: int, entries: list[Entry]) -> None:
        self._append(agent_id, "".join([entry.to_line() for entry in entries]))
        for entry in entries:
            entry.t = round(entry.t, 6)  # as in the file
        self._collected.write(agent_id, entries)

    def _append(self, agent_id: int, lines: str) -> None:
        trace = self._traces[agent_id]
        self._left[agent_id] -= len(lines)
        if self._left[agent_id] < 0 and trace.problem is None:
            trace.problem = os.strerror(errno.EFBIG)
        trace.write(lines)
        self._written_bytes += len(lines)
        if self._written_bytes >= PACKED_FROM_BYTES:
            self._written_bytes = 0
            with contextlib.suppress(OSError):  # the disk is full, and the traces record it
                for path in packable_traces(self._rundir.agents):
                    pack_parts(path)

    def changed(self, record: dict[str, Any]) -> None:
        self._rundir.append_network(record)

    def injected(self, record: dict[str, Any]) -> None:
        self._rundir.append_injected(record)

    def transmitted(self, record: dict[str, Any]) -> None:
        self._rundir.append_channel(record)

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        self._rundir.append_tracks(at_s, places)

    def keep_chains(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        self.export(at_s, incarnations)
        self._rundir.keep_exports_before_final_reconcile()

    def export(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        """Write the current chain exports of these agents. Raises OSError."""
        for incarnation in incarnations:
            path = self._rundir.agents / f"{incarnation.agent.agent_id}.chain.json"
            write_json_atomically(path, incarnation.export(at_s))

    def problems(self) -> dict[int, str]:
        """Return the agents whose traces ended early, each with the reason."""
        return {agent_id: trace.problem for agent_id, trace in self._traces.items() if trace.problem}

    def close(self) -> None:
        for trace in self._traces.values():
            trace.close()


def header(incarnation: SimulatedIncarnation) -> dict[str, Any]:
    """Return the content of a trace header for this incarnation. The result can be passed to `ucp.trace.header_line` as
    keyword arguments.
    """
    agent = incarnation.agent
    clock = {"epoch_us": 0, "speedup": 1, **(incarnation.clock.model_dump() if incarnation.clock else {})}
    return {
        "agent_id": agent.agent_id,
        "roster": sorted(agent.roster),
        "initial_data": agent.initial_data,
        "settings": agent.settings.to_json(),
        "clock": clock,
        "secured": incarnation.secured is not None,
    }


class Recorder(Protocol):
    """An object that records the events of a run as they happen."""

    tracing: bool
    """True if handler runs are recorded. Otherwise `write` is not called."""

    def begin(self, incarnation: SimulatedIncarnation) -> None:
        """Record the start of an agent."""

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """Record that an agent logs an event with `data_bytes` bytes of data."""

    def write(self, agent_id: int, entries: list[Entry]) -> None: ...

    def changed(self, record: dict[str, Any]) -> None:
        """Record a change of the network, or a fault of agents."""

    def injected(self, record: dict[str, Any]) -> None:
        """Record a datagram of the rogue node in the format of `harness.play.rogue._journal`."""

    def transmitted(self, record: dict[str, Any]) -> None:
        """Record a message that left the shared channel, or that a radio dropped. The simulation calls this method only
        if it writes traces.
        """

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Record the positions of the vehicles."""

    def keep_chains(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        """Record the chains of these agents before a final reconcile."""

    def export(self, at_s: float, incarnations: Iterable[SimulatedIncarnation]) -> None:
        """Record the current chains of these agents. Raises OSError."""
