"""`python -m docs.generate.wrong_agents_proof [QUIRK ...]`: what tells each wrong agent from the right one, as a table.

First by its steps: some state that it comes to within small bounds, and some input, of which the right agent would make
something else. Then by what comes of that, within bounds in which everything holds of right agents.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from harness.proof._progress_bar import Ended
from harness.proof.bounds import Bounds
from harness.proof.graph._exploration import explore
from harness.proof.model._any_sender import collect
from harness.proof.model._flaws import Flaw
from harness.proof.model._global_states import Swarm
from harness.proof.questions import _convergence
from ucp.agent import HANDLERS
from ucp.quirks import QUIRKS

MOST_S = 60.0
MOST_BYTES = 4e9
SMALL = Bounds(2, 2, "lossy", reduced=False)
"""Everything holds of right agents (tests/harness/proof)."""
TRIED = (
    SMALL,
    replace(SMALL, faults=("duplicate",)),
    replace(SMALL, blocks=1, settings={"max_block_bytes": 535}),
    replace(SMALL, network="any"),
    replace(SMALL, agents=3),
    replace(SMALL, blocks=3),
    replace(SMALL, agents=4),
)
"""Where a wrong step is looked for, one after the other."""


class Told(NamedTuple):
    """Of a wrong step: which handler's it is, within which bounds, how many instants after the beginning.

    In the network any, how many inputs of the agent's.
    """

    handler: str
    bounds: Bounds
    instants: int


def wrong_step(quirk: str, most_s: float = MOST_S) -> Told | str:
    """The nearest; or in a few words why there is none."""
    undecided = []
    for bounds in TRIED:
        flaw, instants, ended = _first_flaw(_with(quirk, replace(bounds, steps=True)), most_s)
        if flaw is not None and flaw.handler is not None:
            return Told(flaw.handler, bounds, instants)
        if ended != "complete":
            undecided.append(bounds)
    return "not decided" if undecided else "none"


def _first_flaw(bounds: Bounds, most_s: float) -> tuple[Flaw | None, int, Ended]:
    """The nearest, and how many instants it takes, or in the network any, inputs of one agent."""
    if bounds.network == "any":
        collected = collect(bounds, most_bytes=MOST_BYTES, most_s=most_s)
        return collected.flaw, len(collected.way), collected.ended
    graph = explore(Swarm(bounds), most_bytes=MOST_BYTES, most_s=most_s)
    instants = 0 if graph.flawed is None else len(graph.path(graph.flawed)) - 1
    return graph.flaw, instants, graph.ended


def consequence(quirk: str, most_s: float = MOST_S) -> str:
    """What does not hold within the small bounds, in a few words."""
    graph = explore(Swarm(_with(quirk, SMALL)), most_bytes=MOST_BYTES, most_s=most_s)
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
    return "more votes for one chain" if len(live.astray) > 2 else "nothing"


def _with(quirk: str, bounds: Bounds) -> Bounds:
    return replace(bounds, quirks={quirk: 1.0 if QUIRKS[quirk].chance else True})


def row(quirk: str) -> str:
    """One of the table."""
    algorithms = ", ".join(map(str, QUIRKS[quirk].algorithms))
    step = wrong_step(quirk)
    if isinstance(step, Told):
        where = f"Algorithm {HANDLERS[step.handler].algorithm} | {step.bounds.in_words()} | {step.instants}"
    else:
        where = f"{step} | | "
    return f"| `{quirk}` | {algorithms} | {where} | {consequence(quirk)} |"


def main(names: Sequence[str]) -> None:
    sys.stdout.write("| quirk | Algorithm | a wrong step of | within | instants | what comes of it |\n")
    sys.stdout.write("|---|---|---|---|--:|---|\n")
    for name in names or QUIRKS:
        sys.stdout.write(f"{row(name)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
