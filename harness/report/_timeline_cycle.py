"""Under the lanes of a swarm that never finishes: a bracket for each time that it goes round, and the words."""

from math import ceil

from markupsafe import Markup

from harness.archive.run_record import Cycle
from harness.checker.recurring_cycles import findings, in_words
from harness.report._timeline_charts import Chart
from harness.report._timeline_plot import pin, plot, short

HEIGHT = 34
MAX_ROUNDS = 400
"""More brackets than anyone tells apart; the last are drawn."""
MOST_ROUNDS = 1_000_000
MAX_TEXT = 1000

_TOP, _BOTTOM = 3, 12
_TEXT = 28


def row(cycle: Cycle, end_s: float) -> Chart:
    """A chart that ends with the run, at mission second `end_s`."""
    start_s = max(0.0, min(cycle.since_s, end_s))
    period_s = cycle.period_s if cycle.period_s is not None and cycle.period_s > 0 else end_s - start_s
    told = "; ".join(f"agent {finding.agent_id}, {finding.detail}" for finding in findings(cycle))[:MAX_TEXT]
    rounds = ceil(min((end_s - start_s) / period_s, MOST_ROUNDS)) if period_s > 0 else 0
    starts = [start_s + number * period_s for number in range(max(0, rounds - MAX_ROUNDS), rounds)]
    brackets = [_bracket(at_s, min(at_s + period_s, end_s)) for at_s in starts]
    tip = Markup('<rect class="tip" x="{}" width="{}" height="{}"><title>{}</title></rect>').format(
        short(start_s), short(end_s - start_s), HEIGHT, f"{in_words(cycle)}. {told}"
    )
    label = (
        f"every {cycle.period_s:.4g} s since {start_s:.0f} s" if cycle.period_s else f"nothing since {start_s:.0f} s"
    )
    anchor = "end" if start_s > end_s / 2 else "start"
    text = Markup('<text class="scale" text-anchor="{}">{}</text>').format(anchor, label)
    return Chart(
        "goes round" if cycle.period_s else "hangs",
        [],
        plot([*brackets, tip], [pin(start_s, end_s, _TEXT, text)], HEIGHT, end_s, f"{in_words(cycle)}. {told}"),
    )


def _bracket(start_s: float, end_s: float) -> Markup:
    return Markup('<path class="round" d="M{} {}V{}H{}V{}"/>').format(short(start_s), _TOP, _BOTTOM, short(end_s), _TOP)
