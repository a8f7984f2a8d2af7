"""Compute from traces how the mission data spread over the agents. The result describes the agents' chains at each
mission second. The checker computes the same numeric results (`harness.checker._liveness`) for the end of a run.

The module counts the copies of each completed block in the chains of the living agents. Other chains are ignored.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from harness.archive.history import incarnations
from harness.archive.run_record import FaultRecord
from harness.archive.traces import Trace
from ucp.trace import HandlerRun


@dataclass(frozen=True, slots=True)
class ReplicationFigures:
    """The numbers from mission second `at_s` until the next change: chain lengths in blocks, the number of different
    chains, and the number of copies of blocks.

    The numbers of copies are None until an agent completes a block.
    """

    at_s: float
    mutual_chain: int
    longest_chain: int
    distinct_chains: int
    copies_min: int | None
    copies_mean: float | None


def replication_of(traces: Mapping[int, Trace], faults: Iterable[FaultRecord]) -> list[ReplicationFigures]:
    """Return the numbers of copies and chains at mission second 0 and after each change."""
    steps: list[tuple[float, int, int, FaultRecord | HandlerRun]] = []
    for fault in faults:
        steps += [(fault.at_s, 0, agent, fault) for agent in fault.agents or () if agent in traces]
    for agent, trace in traces.items():
        for incarnation, runs in enumerate(incarnations(trace), 1):
            steps += [(run.t, incarnation, agent, run) for run in runs if run.changes]
    steps.sort(key=lambda step: step[:3])
    chains = _LivingChains(traces)
    states = [chains.replication(0.0)]
    for number, (at_s, incarnation, agent, step) in enumerate(steps):
        if isinstance(step, FaultRecord):
            chains.apply_fault(agent, step)
        else:
            chains.apply_run(agent, incarnation, step)
        if number + 1 == len(steps) or steps[number + 1][0] > at_s:
            now = chains.replication(at_s)
            if states[-1].at_s == at_s:
                states[-1] = now
            elif replace(now, at_s=states[-1].at_s) != states[-1]:
                states.append(now)
    return states


class _LivingChains:
    """The chains of the living agents, with counts of the blocks in them. A prefix consists of the first blocks of a
    chain. Each prefix is assigned a number, and equal prefixes of different chains have the same number. To compare two
    prefixes, the class therefore needs to compare only their numbers.
    """

    def __init__(self, agents: Iterable[int]) -> None:
        self._paths: dict[int, list[tuple[int, str]]] = {agent: [] for agent in agents}
        self._incarnation = dict.fromkeys(self._paths, 1)
        self._prefixes: dict[tuple[int, str], int] = {}
        self._sharing: Counter[int] = Counter()
        self._mutual = 0  # a lower bound of the length of the mutual chain
        self._copies: Counter[str] = Counter()
        self._completed: set[str] = set()
        self._blocks_with: Counter[int] = Counter()  # number of copies -> number of completed blocks with that many
        self._copies_of_completed = 0

    def apply_fault(self, agent: int, fault: FaultRecord) -> None:
        if fault.loses_data:
            self._empty(agent)
            self._paths.pop(agent, None)
        elif fault.kind.begins_incarnation:
            self._mutual = 0 if agent not in self._paths else self._mutual
            self._paths.setdefault(agent, [])

    def apply_run(self, agent: int, incarnation: int, run: HandlerRun) -> None:
        """Apply the changes of a handler run to the agent's chain. The first handler run after a restart begins with an
        empty chain.
        """
        if incarnation > self._incarnation[agent]:
            self._incarnation[agent] = incarnation
            self._empty(agent)
            self._paths[agent] = []
            self._mutual = 0
        if agent not in self._paths:
            return
        for operation, block in run.changes:
            if operation == "complete" and block not in self._completed:
                self._completed.add(block)
                self._blocks_with[self._copies[block]] += 1
                self._copies_of_completed += self._copies[block]
            elif operation == "chain+":
                self._append(agent, block)
            elif operation == "chain-" and self._paths[agent]:
                self._pop(agent)

    def _append(self, agent: int, block: str) -> None:
        path = self._paths[agent]
        below = path[-1][0] if path else 0
        prefix = self._prefixes.setdefault((below, block), len(self._prefixes) + 1)
        path.append((prefix, block))
        self._sharing[prefix] += 1
        self._count(block, 1)

    def _pop(self, agent: int) -> None:
        path = self._paths[agent]
        prefix, block = path.pop()
        self._sharing[prefix] -= 1
        self._mutual = min(self._mutual, len(path))
        self._count(block, -1)

    def _empty(self, agent: int) -> None:
        for prefix, block in self._paths.get(agent, ()):
            self._sharing[prefix] -= 1
            self._count(block, -1)

    def _count(self, block: str, difference: int) -> None:
        if block in self._completed:
            self._blocks_with[self._copies[block]] -= 1
            self._blocks_with[self._copies[block] + difference] += 1
            self._copies_of_completed += difference
        self._copies[block] += difference

    def replication(self, at_s: float) -> ReplicationFigures:
        paths = list(self._paths.values())
        first_path: list[tuple[int, str]] = paths[0] if paths else []
        while self._mutual < len(first_path) and self._sharing[first_path[self._mutual][0]] == len(paths):
            self._mutual += 1
        completed = len(self._completed)
        return ReplicationFigures(
            at_s,
            self._mutual,
            max(map(len, paths), default=0),
            len({path[-1][0] if path else 0 for path in paths}),
            min((copies for copies, blocks in self._blocks_with.items() if blocks), default=None),
            self._copies_of_completed / completed if completed else None,
        )
