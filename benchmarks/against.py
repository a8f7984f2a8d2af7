"""Compare the speed of simulated runs with that of another revision: `python -m benchmarks.against HEAD~20 [--rounds
15]`.

The other revision is checked out in a temporary directory. Both revisions play the same seeds alternately, each in a
process of its own. The ratio is the processor time of this revision divided by that of the other one, in the same
round. A ratio below 1 means that this revision is faster. `--large` also plays 50 agents, and the thesis's matrix with
200 seeds on one core, which takes minutes.

The scenario has 20 minutes at 15 % loss with a final reconcile. Each revision judges its own runs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.rounds import Spread, show

ROOT = Path(__file__).resolve().parent.parent
PLAYER = Path(__file__).with_name("played_by.py")

SMALL = {
    "5 agents, untraced": ("untraced 5", "untraced 5"),
    "5 agents, traced": ("traced 5", "traced 5"),
    "5 agents, traced beside untraced": ("untraced 5", "traced 5"),
    "a seed of explore": ("explore", "explore"),
}
LARGE = {
    "50 agents, untraced": ("untraced 50", "untraced 50"),
    "50 agents, traced": ("traced 50", "traced 50"),
    "a run of the matrix": ("matrix", "matrix"),
}
"""Row -> the runs of the other revision, and the runs of this one."""


class Player:
    """A process that plays runs with the code in the directory `root`."""

    def __init__(self, root: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, PLAYER],
            env={**os.environ, "PYTHONPATH": str(root)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def seconds(self, what: str, seed: int) -> float:
        """Return the processor time of each run in seconds."""
        assert self._process.stdin and self._process.stdout, "they are pipes"
        self._process.stdin.write(f"{what}/{seed}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            sys.exit(f"the process that plays {what} ended; its error is above")
        return float(answer)

    def close(self) -> None:
        self._process.communicate()


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """Check out this revision into a temporary directory, which exists until the block ends."""
    with tempfile.TemporaryDirectory() as directory:
        tree = Path(directory) / "tree"
        git = ("git", "-C", str(ROOT), "worktree")
        if subprocess.run([*git, "add", "--quiet", "--detach", tree, revision], check=False).returncode:
            sys.exit(f"git cannot check out {revision!r}: name a commit of this project, such as HEAD~10")
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", tree], check=True)


def row(name: str, plays: tuple[str, str], other: Player, this: Player, rounds: int) -> dict[str, Any]:
    played_before, played_now = plays
    before, now = [], []
    for seed in range(1, rounds + 1):
        before.append(other.seconds(played_before, seed))
        now.append(this.seconds(played_now, seed))
    return {
        "what": name,
        "then, ms": Spread.of(1000 * seconds for seconds in before),
        "now, ms": Spread.of(1000 * seconds for seconds in now),
        "now, per second": f"{1 / Spread.of(now).median:.1f}",
        "ratio": Spread.of_ratios(now, before),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="other revision, as git names it")
    parser.add_argument("--rounds", type=int, default=15, help="number of rounds")
    parser.add_argument("--large", action="store_true", help="also 50 agents and the matrix, one round each")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    with checked_out(arguments.revision) as tree, ExitStack() as players:
        other, this = Player(tree), Player(ROOT)
        players.callback(other.close)
        players.callback(this.close)
        for player in (other, this):
            player.seconds("explore", 0)  # includes the imports and caches of the first run
        rows = [row(name, plays, other, this, arguments.rounds) for name, plays in SMALL.items()]
        if arguments.large:
            rows += [row(name, plays, other, this, 1) for name, plays in LARGE.items()]
    show(rows, {"then, ms": ".1f", "now, ms": ".1f", "ratio": ".2f"}, arguments.json)


if __name__ == "__main__":
    main()
