"""What traces show of characteristics 2 and 3. Both ask what an agent held after each step, so it is replayed once."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from harness.archive.traces import Held, Trace
from harness.checker.judgement import Finding
from ucp.trace import HandlerRun

NameOf = Callable[[str], str]
"""A block's name from its hash."""


@dataclass
class Replayed:
    """Where an agent was idle with blocks that are not in its chain, and where it held a block twice."""

    idle_uncommitted: list[Finding] = field(default_factory=list)
    copies: list[Finding] = field(default_factory=list)


def replay(traces: Mapping[int, Trace], name: NameOf) -> Replayed:
    replayed = Replayed()
    for agent_id, trace in traces.items():
        for life in trace.lives():
            held = Held()
            for line, run in life:
                if run.changes:
                    held.replay(run)
                    replayed.copies += _copies(agent_id, line, run, held, name)
                if run.state.idle and (held.not_in_chain or held.size["deque"] or held.size["stack"]):
                    replayed.idle_uncommitted.append(_idle(agent_id, line, run, held, name))
    return replayed


def _copies(agent_id: int, line: int, run: HandlerRun, held: Held, name: NameOf) -> Iterator[Finding]:
    where = f"trace line {line}, t={run.t:g} s, {run.handler}"
    if held.impossible:
        yield Finding(agent_id, f"{where}: {held.impossible}")
    for _, block_hash in run.changes:
        if held.copies[block_hash] > 1:
            yield Finding(agent_id, f"{where}: a second copy of block {name(block_hash)}", name(block_hash), block_hash)


def _idle(agent_id: int, line: int, run: HandlerRun, held: Held, name: NameOf) -> Finding:
    waiting = next(iter(held.not_in_chain), None)
    return Finding(
        agent_id,
        f"trace line {line}, t={run.t:g} s: idle after {run.handler} with {held.size['deque']} blocks to be committed "
        f"and {held.size['stack']} on the reconcile stack",
        name(waiting) if waiting else None,
        waiting,
    )
