"""Write the page about a night: findings, coverage, and earlier nights. The template escapes all text."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from harness.present import svg, text
from harness.present.svg import ChartArea, linear_axis, n
from harness.report import html

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE = _TEMPLATE.with_name("page.css").read_text(encoding="utf-8")
HEIGHT = 230
MOST_NIGHTS = 60
MOST_BRANCHES = 100


def to_html(night: dict[str, Any], nights: Sequence[dict[str, Any]]) -> str:
    """Return the page about a night as HTML.

    `night` contains the results of this night as JSON. `nights` contains the results of all stored nights, including
    this night.
    """
    last = list(nights)[-MOST_NIGHTS:]
    return html.render(
        _TEMPLATE,
        styles=[html.PAGE_STYLE + _STYLE, svg.STYLE],
        night=night,
        began=text.started(night["started_at"]),
        headline=headline(night),
        unfinished=unfinished_in_words(night.get("unfinished", 0)),
        kind="violated" if any(finding["status"] != "resolved" for finding in night["findings"]) else "holds",
        growth=_curve("local states by run of this night", night["growth"], "runs"),
        trend=_curve(
            "local states at the end of each night",
            [[number, each["local_states"]] for number, each in enumerate(last, 1)],
            "night",
        )
        if len(last) > 1
        else "",
        not_taken=night["coverage"]["branches"]["not_taken"][:MOST_BRANCHES],
    )


def unfinished_in_words(runs: int) -> str:
    """Return a sentence about runs in which the swarm only needed more time."""
    one = runs == 1
    return (
        f"not finished: {runs:,} run{'' if one else 's'} need{'s' if one else ''} a higher settle.limit_s to be judged"
    )


def headline(night: dict[str, Any]) -> str:
    """Return the headline of the page. It contains the number of findings with each status, the number of runs, and the
    number of agent states.
    """
    counts = dict.fromkeys(("new", "ongoing", "rare", "resolved"), 0)
    for finding in night["findings"]:
        counts[finding["status"]] += 1
    by_status = ", ".join(f"{count} {status}" for status, count in counts.items() if count) or "no findings"
    broken_off = "; interrupted" if night["outcome"] == "interrupted" else ""
    return f"{by_status}; {night['runs']:,} runs, {night['local_states']:,} local states{broken_off}"


def _curve(title: str, samples: Sequence[Sequence[int]], unit: str) -> Markup:
    if len(samples) < 2:
        return Markup("")
    area = ChartArea(0, 0, svg.WIDTH, HEIGHT)
    across = linear_axis(0, max(1, *(x for x, _ in samples)), area.across)
    up = linear_axis(0, max(1, *(y for _, y in samples)), area.up)
    frame = svg.frame(
        title, across, up, (f"{tick:,.0f}" for tick in across.ticks), (f"{tick:,.0f}" for tick in up.ticks)
    )
    points = " ".join(f"{n(across(x))},{n(up(y))}" for x, y in samples)
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="chart" role="img" viewBox="0 0 {w} {h}" '
        'aria-label="{title}, by {unit}" font-size="13" fill="none">{frame}'
        '<g class="series first"><polyline points="{points}" stroke="{colour}" stroke-width="2"/></g></svg>'
    ).format(w=svg.WIDTH, h=HEIGHT, title=title, unit=unit, frame=frame, points=points, colour=svg.COLOURS[0])
