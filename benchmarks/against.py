"""Compare the speed of this revision with another revision and with a bare model: `python -m benchmarks.against
HEAD~20`.

The argument is the directory of another clone, or a revision, which the benchmark checks out in a temporary directory.
Each of the two sides plays in its own process. In each round, the two sides and the bare model
(`benchmarks.bare_model`) play the same seed alternately. A ratio below 1 means that this revision needs less processor
time than the other one or the model. If this clone has compiled modules, it uses them. A revision that the benchmark
checks out has no compiled modules. Thus the argument `HEAD` measures the effect of the compilation. Both sides may
write bytecode, even if PYTHONDONTWRITEBYTECODE is set. Otherwise, the row "from the shell" would measure Python's
parser.

The scenario has 20 minutes at 15 % loss with a final reconcile. Each revision judges its own runs. `--large` also plays
50 agents and a larger proof. Both together take minutes.
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
    "5 agents, untraced": ("untraced 5", "bare 5"),
    "5 agents, traced and judged": ("traced 5", "bare 5"),
    "20 agents, untraced": ("untraced 20", "bare 20"),
    "20 agents, traced and judged": ("traced 20", "bare 20"),
    "a seed of explore": ("explore", "bare 5"),
    "a run of the matrix, judged": ("matrix", None),
    "a state of prove, 4/2 lossy": ("prove 4/2", None),
    "run --backend sim, from the shell": ("shell", "bare 5"),
}
LARGE = {
    "50 agents, untraced": ("untraced 50", "bare 50"),
    "50 agents, traced and judged": ("traced 50", "bare 50"),
    "a state of prove, 3/3 lossy": ("prove 3/3", None),
}
"""Rows of the table. Each has the kind of runs that both revisions play, and the kind of runs of the bare model."""


class Player:
    """A process that plays runs with the code in the directory `root`."""

    def __init__(self, root: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(root)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        self._process = subprocess.Popen(
            [sys.executable, PLAYER],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def seconds(self, what: str, seed: int) -> float:
        """Play runs of the kind `what` with this seed, and return the processor seconds per run."""
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
    """Check out this revision into a temporary directory, which exists until the block ends.

    If the argument is the directory of another clone, return this directory unchanged.
    """
    if (Path(revision) / "harness").is_dir():
        yield Path(revision).resolve()
        return
    with tempfile.TemporaryDirectory() as directory:
        tree = Path(directory) / "tree"
        git = ("git", "-C", str(ROOT), "worktree")
        if subprocess.run([*git, "add", "--quiet", "--detach", tree, revision], check=False).returncode:
            sys.exit(f"git cannot check out {revision!r}: name a commit of this project, such as HEAD~10")
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", tree], check=True)


def row(name: str, plays: tuple[str, str | None], other: Player, this: Player, rounds: int) -> dict[str, Any]:
    play, bare_play = plays
    before, now, bare = [], [], []
    for seed in range(1, rounds + 1):
        before.append(other.seconds(play, seed))
        now.append(this.seconds(play, seed))
        if bare_play is not None:
            bare.append(other.seconds(bare_play, seed))
    return {
        "what": name,
        "then, ms": Spread.of(1000 * seconds for seconds in before),
        "now, ms": Spread.of(1000 * seconds for seconds in now),
        "now, per second": f"{1 / Spread.of(now).median:.1f}",
        "ratio": Spread.of_ratios(now, before),
        "beside the bare model": f"{sum(now) / sum(bare):.2f}" if bare else "",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="other revision, as git names it, or the directory of another clone")
    parser.add_argument("--rounds", type=int, default=15, help="number of rounds")
    parser.add_argument("--large", action="store_true", help="also 50 agents and a larger proof, one round each")
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
    show(rows, {"then, ms": ".3g", "now, ms": ".3g", "ratio": ".2f"}, arguments.json)


if __name__ == "__main__":
    main()
