"""Print a table of the deliberate errors that a proof detects: `python -m docs.generate.wrong_agents_proof [QUIRK
...]`.

The page is docs/appendix/proof-bounds.md. The program examines each quirk twice. First, it compares each step within
small bounds with the step of a correct agent. Second, it searches for a violated property within bounds in which
correct agents violate none.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from harness.proof._progress_bar import Ended
from harness.proof.bounds import Bounds
from harness.proof.graph._exploration import explore
from harness.proof.model._any_sender import collect
from harness.proof.model._flaws import PropertyViolation
from harness.proof.model._global_states import ModelSwarm
from harness.proof.questions import _convergence
from ucp.agent import HANDLERS
from ucp.quirks import QUIRKS

MOST_S = 60.0
MOST_BYTES = 4e9
SMALL = Bounds(2, 2, "lossy", reduced=False)
"""Bounds within which correct agents violate no property (tests/harness/proof)."""
TRIED = (
    SMALL,
    replace(SMALL, faults=("duplicate",)),
    replace(SMALL, blocks=1, settings={"max_block_bytes": 535}),
    replace(SMALL, network="any"),
    replace(SMALL, agents=3),
    replace(SMALL, blocks=3),
    replace(SMALL, agents=4),
)
"""Bounds within which the program searches for a wrong step, in this order."""


class WrongStep(NamedTuple):
    """A wrong step: its handler, the bounds in which it occurs, and its distance from the initial state.

    In the network `any`, `instants` counts the inputs of one agent.
    """

    handler: str
    bounds: Bounds
    instants: int


def wrong_step(quirk: str, most_s: float = MOST_S) -> WrongStep | str:
    """Return the wrong step nearest to the initial state, or the reason why none is known."""
    undecided = []
    for bounds in TRIED:
        flaw, instants, ended = _first_flaw(_with(quirk, replace(bounds, steps=True)), most_s)
        if flaw is not None and flaw.handler is not None:
            return WrongStep(flaw.handler, bounds, instants)
        if ended != "complete":
            undecided.append(bounds)
    return "not decided" if undecided else "none"


def _first_flaw(bounds: Bounds, most_s: float) -> tuple[PropertyViolation | None, int, Ended]:
    """Return the violation nearest to the initial state, its distance, and the end of the search."""
    if bounds.network == "any":
        collected = collect(bounds, most_bytes=MOST_BYTES, most_s=most_s)
        return collected.flaw, len(collected.way), collected.ended
    graph = explore(ModelSwarm(bounds), most_bytes=MOST_BYTES, most_s=most_s)
    instants = 0 if graph.flawed is None else len(graph.path(graph.flawed)) - 1
    return graph.flaw, instants, graph.ended


def violation(quirk: str, most_s: float = MOST_S) -> str:
    """Return the first property that an agent with this error violates within small bounds."""
    graph = explore(ModelSwarm(_with(quirk, SMALL)), most_bytes=MOST_BYTES, most_s=most_s)
    if graph.flaw is not None:
        return f"characteristic {graph.flaw.kind}" if graph.flaw.kind.isdecimal() else graph.flaw.kind
    if graph.ended != "complete":
        return f"not decided ({graph.ended})"
    live = _convergence.look(graph)
    if live.lost is not None:
        return "no way to one chain"
    if live.cycles:
        return "livelock"
    if not live.decided:
        return "not decided (states)"
    return "more votes for one chain" if len(live.astray) > 2 else "none"


def _with(quirk: str, bounds: Bounds) -> Bounds:
    return replace(bounds, quirks={quirk: 1.0 if QUIRKS[quirk].chance else True})


def row(quirk: str) -> str:
    """Return the table row of an error."""
    algorithms = ", ".join(map(str, QUIRKS[quirk].algorithms))
    step = wrong_step(quirk)
    if isinstance(step, WrongStep):
        where = f"Algorithm {HANDLERS[step.handler].algorithm} | {step.bounds.in_words()} | {step.instants}"
    else:
        where = f"{step} | | "
    return f"| `{quirk}` | {algorithms} | {where} | {violation(quirk)} |"


def main(names: Sequence[str]) -> None:
    sys.stdout.write("| quirk | Algorithm | wrong step in | bounds | instants | violation |\n")
    sys.stdout.write("|---|---|---|---|--:|---|\n")
    for name in names or QUIRKS:
        sys.stdout.write(f"{row(name)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
