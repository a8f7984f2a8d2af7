"""Measure the cost and the effect of each protocol correction at many loss rates: `python -m docs.generate.cures`.

Runs with a correction use the same seeds as runs with the default settings. This program writes the tables of the page.
The text around them is written by hand.
"""

import sys
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from harness.present import text
from harness.run.parallel import FailedTask, cores, sweep
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.scenario.agent_options import Stagger
from harness.sweep.matrix._estimate import METRICS, Figures, Metric, figure
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint, load_matrix
from harness.sweep.matrix.matrix_table import say_interval, say_mean
from ucp.agent_files import write_atomically

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/appendix/livelock-measurements.md"
MATRIX = ROOT / "scenarios/thesis_matrix.yaml"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"
SHOWN = ("uniform", "mutual_share", "reconciles", "messages_per_block")
ALL_IDLE = "All {runs:,} runs of each row became idle in time."
UNIFORM_AT = Metric("uniform_at_s", "seconds until one chain, of runs that have one", figure("uniform_at_s"))
TIMER_S = 0.5
STAGGER: Stagger = {"vote_timeout_s": 0.3, "phase1_timeout_s": 0.15, "phase2_timeout_s": 0.15, "phase3_timeout_s": 0.15}
"""Each agent's timers are longer than those of the agent with the next lower ID, by 3 % of the default durations."""
SEEDS = 50
"""Number of seeds. The program uses the first seeds of the matrix."""

CURES: dict[str, dict[str, Any]] = {
    "none (thesis)": {},
    f"`stagger: {{vote_timeout_s: {TIMER_S}}}`": {"stagger": {"vote_timeout_s": TIMER_S}},
    f"`stagger: {{phase1_timeout_s: {TIMER_S}}}`": {"stagger": {"phase1_timeout_s": TIMER_S}},
    "all timers staggered by 3 %": {"stagger": STAGGER},
    "`asks_after_commit: true`": {"settings": {"asks_after_commit": True}},
    "`asks_after_commit`, all timers staggered": {"settings": {"asks_after_commit": True}, "stagger": STAGGER},
    "`top_needs_majority: true`": {"settings": {"top_needs_majority": True}},
    "`top_needs_majority`, all timers staggered": {"settings": {"top_needs_majority": True}, "stagger": STAGGER},
    "all three": {"settings": {"top_needs_majority": True, "asks_after_commit": True}, "stagger": STAGGER},
    "`phase1_tie: pop`": {"settings": {"phase1_tie": "pop"}},
    "`phase2_tie: block`": {"settings": {"phase2_tie": "block"}},
}


class Task(NamedTuple):
    """A run of the matrix with a correction."""

    cure: str
    point: MatrixPoint
    seed: int


def play(matrix: Matrix, task: Task) -> tuple[Figures, bool]:
    """Return the figures of a run, and whether the swarm became idle."""
    document = matrix.scenario_at(task.point).model_dump(exclude_unset=True) | CURES[task.cure]
    simulated = simulate(Scenario.model_validate(document), task.seed)
    return simulated.result.figures, simulated.played.settled


def tables(jobs: int) -> str:
    """Return Markdown with a table for each figure. A table has a row for each correction and a column for each loss
    rate.
    """
    matrix = load_matrix(MATRIX)
    tasks = [Task(cure, point, seed) for cure in CURES for point in matrix.points for seed in matrix.seed_list[:SEEDS]]
    figures: dict[tuple[str, float], list[Figures]] = defaultdict(list)
    settled: dict[str, list[bool]] = defaultdict(list)
    with sweep(tasks, partial(play, matrix), jobs, what="runs") as outcomes:
        for task, outcome in outcomes:
            if isinstance(outcome, FailedTask):
                raise SystemExit(f"{task}: {outcome.reason}")
            figures[task.cure, task.point.loss].append(outcome[0])
            settled[task.cure].append(outcome[1])
    shown = [metric for metric in METRICS if metric.name in SHOWN] + [UNIFORM_AT]
    parts = [_table(metric, matrix.loss, figures) for metric in shown]
    runs = len(settled["none (thesis)"])
    active = ", ".join(f"{cure} {runs - sum(those)}" for cure, those in settled.items() if not all(those))
    sentence = f"Of {runs:,} runs of each row, some did not become idle in time: {active}." if active else ALL_IDLE
    return "\n".join([*parts, f"{sentence.format(runs=runs)}\n"])


def _table(metric: Metric, losses: list[float], figures: dict[tuple[str, float], list[Figures]]) -> str:
    lines = [
        [metric.label, *(text.percent(loss) for loss in losses)],
        ["---", *("--:" for _ in losses)],
        *([cure, *(_cell(metric, figures[cure, loss]) for loss in losses)] for cure in CURES),
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(metric: Metric, runs: list[Figures]) -> str:
    estimate = metric.estimate(runs)
    if not estimate.n:
        return "-"
    return f"{say_mean(metric, estimate)}<br><sub>{say_interval(metric, estimate)}</sub>"


def main(jobs: int) -> None:
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    _, after = rest.split(END)
    write_atomically(PAGE, f"{before}{BEGIN}{tables(jobs)}{END}{after}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else cores())
