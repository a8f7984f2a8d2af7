"""The files of a simulated run, and the recorder of events that cannot be asked for at the end."""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from harness.archive.directory import RunDirectory
from harness.play.simulation.incarnations import Incarnation
from netem.radio import Place
from ucp.agent_files import TraceFile, write_json_atomically
from ucp.trace import Entry, header_line


class OnDisk:
    """The simulation's `Recorder` that writes them."""

    tracing = True

    def __init__(self, rundir: RunDirectory) -> None:
        self._rundir = rundir
        self._traces: dict[int, TraceFile] = {}

    def begin(self, life: Incarnation) -> None:
        agent_id = life.agent.agent_id
        if agent_id not in self._traces:
            self._traces[agent_id] = TraceFile(self._rundir.agents / f"{agent_id}.trace.jsonl")
        self._traces[agent_id].write(header_line(**header(life)))

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """The block that it becomes part of has it."""

    def write(self, agent_id: int, entries: list[Entry]) -> None:
        self._traces[agent_id].write("".join([entry.to_line() for entry in entries]))

    def changed(self, record: dict[str, Any]) -> None:
        self._rundir.append_network(record)

    def injected(self, record: dict[str, Any]) -> None:
        self._rundir.append_injected(record)

    def transmitted(self, record: dict[str, Any]) -> None:
        self._rundir.append_channel(record)

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        self._rundir.append_tracks(at_s, places)

    def keep_chains(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        self.export(at_s, lives)
        self._rundir.keep_exports_before_final_reconcile()

    def export(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        """Raises OSError."""
        for life in lives:
            path = self._rundir.agents / f"{life.agent.agent_id}.chain.json"
            write_json_atomically(path, life.export(at_s))

    def problems(self) -> dict[int, str]:
        """Why the trace of which agent ends early."""
        return {agent_id: trace.problem for agent_id, trace in self._traces.items() if trace.problem}

    def close(self) -> None:
        for trace in self._traces.values():
            trace.close()


def header(life: Incarnation) -> dict[str, Any]:
    """The first line of a trace, as keywords of `ucp.trace.header_line`."""
    agent = life.agent
    clock = {"epoch_us": 0, "speedup": 1, **(life.clock.model_dump() if life.clock else {})}
    return {
        "agent_id": agent.agent_id,
        "roster": sorted(agent.roster),
        "initial_data": agent.initial_data,
        "settings": agent.settings.told(),
        "clock": clock,
        "secured": life.secured is not None,
    }


class Recorder(Protocol):
    tracing: bool
    """Whether handler runs are wanted; if not, `write` is not called."""

    def begin(self, life: Incarnation) -> None:
        """An agent starts, or starts anew."""

    def logged(self, at_s: float, agent_id: int, data_bytes: int) -> None:
        """An agent is about to log an event with so much data."""

    def write(self, agent_id: int, entries: list[Entry]) -> None: ...

    def changed(self, record: dict[str, Any]) -> None:
        """A change of the network, or a fault of agents, was made."""

    def injected(self, record: dict[str, Any]) -> None:
        """The rogue node has sent something; see `harness.play.rogue._journal`."""

    def transmitted(self, record: dict[str, Any]) -> None:
        """Record a message that left the shared channel, or that a radio dropped. Called only while tracing."""

    def moved(self, at_s: float, places: Mapping[int, Place]) -> None:
        """Here are the vehicles now, if any fly."""

    def keep_chains(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        """A final reconcile is about to put the chains of these agents in order."""

    def export(self, at_s: float, lives: Iterable[Incarnation]) -> None:
        """Somebody wants to see the chains of these agents as they are now. Raises OSError."""
