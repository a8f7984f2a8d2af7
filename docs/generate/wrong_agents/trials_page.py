"""Play agents with deliberate errors, and write the table in docs/appendix/wrong-agents.md: `python -m
docs.generate.wrong_agents.trials_page [QUIRK ...]`.

The table comes from many runs of each quirk. A finding counts only if the correct agent does not have it in the same
mission. The text around the table is written by hand.
"""

import sys
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from statistics import median

from docs.generate.matrix_thesis import BEGIN, END, put_between_markers
from docs.generate.wrong_agents.wrong_trial import Trial, play
from harness.run.parallel import FailedTask, cores, sweep
from ucp.agent import HANDLERS
from ucp.agent_files import write_atomically
from ucp.quirks import QUIRKS

__all__ = ["BEGIN", "END", "NOTHING", "PAGE", "findings_of", "main", "row", "rows_of"]

PAGE = Path(__file__).parents[2] / "appendix/wrong-agents.md"
SEEDS = range(1, 101)
NOTHING = "**nothing**"
HEADER = (
    f"| quirk | Algorithm | mistake | found by (number of {len(SEEDS)} seeds) | seeds | minutes | "
    "handler named | correct | first found |\n|---|--:|---|---|--:|--:|---|--:|---|\n"
)

Trials = dict[int, Trial]
"""The trial of each seed."""


def findings_of(wrong: Trial, right: Trial) -> dict[str, float | None]:
    """Return the findings for the wrong swarm that the correct swarm in the same mission does not have."""
    return {key: first_s for key, first_s in wrong.bad.items() if key not in right.bad}


def row(quirk: str, wrong: Trials, right: Trials) -> str:
    """Return the table row of an error: the checks that detect it, the number of seeds, and the time until
    detection.
    """
    about = QUIRKS[quirk]
    findings = {seed: findings_of(trial, right[seed]) for seed, trial in wrong.items()}
    counts = Counter(key for finding in findings.values() for key in finding)
    by = ", ".join(f"{key} ({count})" for key, count in sorted(counts.items(), key=_most_first)) or NOTHING
    firsts = [min(times) for finding in findings.values() if (times := [t for t in finding.values() if t is not None])]
    named = Counter(trial.named for trial in wrong.values() if trial.named)
    handler, _ = named.most_common(1)[0] if named else ("\u2013", 0)
    rightly = sum(count for name, count in named.items() if name and HANDLERS[name].algorithm in about.algorithms)
    first = next((seed for seed in sorted(findings) if findings[seed]), None)
    cells = (
        f"`{quirk}`",
        ", ".join(map(str, about.algorithms)),
        about.sentence,
        by,
        f"{sum(map(bool, findings.values()))}",
        f"{median(firsts) / 60:.1f}" if firsts else "\u2013",
        f"`{handler}`" if named else handler,
        f"{rightly} of {named.total()}" if named else "\u2013",
        first_found(first, findings[first]) if first is not None else "\u2013",
    )
    return f"| {' | '.join(cells)} |\n"


def first_found(seed: int, finding: dict[str, float | None]) -> str:
    """Return the first seed for which a check detects the error, and these checks, such as "seed 2: steps, 2"."""
    return f"seed {seed}: {', '.join(sorted(finding, reverse=True))}"


def _most_first(counted: tuple[str, int]) -> tuple[int, str]:
    return -counted[1], counted[0]


def rows_of(page: str) -> dict[str, str]:
    """Return the rows of the table on the page, by the name of the error."""
    table = page.split(BEGIN)[1].split(END)[0]
    lines = [line for line in table.splitlines(keepends=True) if line.startswith("| `")]
    return {line.split("`")[1]: line for line in lines}


def main(names: Sequence[str]) -> None:
    """Play the named errors, or all errors if none is named. Keep the other rows of the table."""
    played: dict[str | None, Trials] = {}
    tasks = list(product([None, *(names or QUIRKS)], SEEDS))
    with sweep(tasks, lambda task: play(*task), cores(), what="runs") as outcomes:
        for (name, seed), trial in outcomes:
            if isinstance(trial, FailedTask):
                raise SystemExit(f"{name}, seed {seed}: {trial.reason}")
            played.setdefault(name, {})[seed] = trial
    right = played.pop(None)
    page = PAGE.read_text(encoding="utf-8")
    rows = rows_of(page) | {name: row(name, trials, right) for name, trials in played.items() if name}
    table = HEADER + "".join(rows[name] for name in QUIRKS if name in rows)
    charged = Counter(key for trial in right.values() for key in trial.bad)
    sys.stdout.write(f"the correct agent has findings in {sum(bool(t.bad) for t in right.values())} seeds: {charged}\n")
    write_atomically(PAGE, put_between_markers(page, table))


if __name__ == "__main__":
    main(sys.argv[1:])
