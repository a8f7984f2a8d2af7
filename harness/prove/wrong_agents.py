"""`python -m harness.prove.wrong_agents [QUIRK ...]`: what tells each wrong agent from the right one, as a table.

Of 2 agents with 2 blocks that may lose any message everything holds if they are right (tests/harness/prove): whatever
does not, tells.
"""

import sys
from collections.abc import Sequence

from harness.prove import liveness
from harness.prove.bounds import Bounds
from harness.prove.explore import explore
from harness.prove.swarm import Swarm
from ucp.quirks import QUIRKS

MOST_S = 60.0
MOST_BYTES = 4e9


def told_by(quirk: str) -> str:
    """What does not hold, in a few words."""
    value = 1.0 if QUIRKS[quirk].chance else True
    swarm = Swarm(Bounds(2, 2, "lossy", quirks={quirk: value}, reduced=False))
    graph = explore(swarm, most_bytes=MOST_BYTES, most_s=MOST_S)
    if graph.flaw is not None:
        return f"characteristic {graph.flaw.kind}" if graph.flaw.kind.isdecimal() else graph.flaw.kind
    if graph.ended != "complete":
        return f"not decided ({graph.ended})"
    live = liveness.look(graph)
    if live.lost is not None:
        return "no way to one chain"
    if live.cycles:
        return "livelock"
    if not live.decided:
        return "not decided (states)"
    return "more votes for one chain" if len(live.astray) > 2 else "not told"


def main(names: Sequence[str]) -> None:
    for name in names or QUIRKS:
        sys.stdout.write(f"| `{name}` | {', '.join(map(str, QUIRKS[name].algorithms))} | {told_by(name)} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
