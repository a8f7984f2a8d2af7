"""Write the report of a matrix: one HTML file that loads no other files and runs no script.

The report shows a heatmap of a numeric result, its trend over the nights, and the runs of each cell with a command that
plays one of them again. The template escapes all text from scenarios, runs and earlier nights.
"""

from collections.abc import Iterator
from pathlib import Path

from markupsafe import Markup

from harness.errors import CANNOT_HERE
from harness.present import svg, text
from harness.report import html
from harness.report.agent_programs import asked_for
from harness.scenario.verdict_names import RUN_CHECKS
from harness.sweep.matrix import _growth_table
from harness.sweep.matrix._comparison import ChangedRuns
from harness.sweep.matrix._growth_picture import draw_growth
from harness.sweep.matrix._matrix_file import scenario_file
from harness.sweep.matrix._matrix_picture import draw, series_of
from harness.sweep.matrix.matrix_record import MatrixRecord
from harness.sweep.matrix.matrix_run import Finished
from harness.sweep.matrix.matrix_table import (
    changed_runs,
    describe_coverage,
    explanation,
    improvements,
    name_of,
    say_lengths,
    troubles,
    unjudged,
    verdict,
)
from harness.sweep.matrix.nights import StoredNights
from harness.sweep.matrix.report import _heatmap, _trend
from harness.sweep.matrix.report._drilldown import drilldown

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE, _GROWTH_STYLE = (_TEMPLATE.with_name(f"{name}.css").read_text(encoding="utf-8") for name in ("page", "growth"))


def to_html(finished: Finished, directory: Path, nights: StoredNights | None = None) -> str:
    """Return the page as HTML. `directory` is the directory into which the page is written, and which contains the kept
    runs. If this night is finished, `nights` contains it too.
    """
    record = finished.record
    shown = _heatmap.known_figures(record.cells)
    drawn = _trend.nights_drawn(nights.records, record, len(shown)) if nights else []
    return html.render(
        _TEMPLATE,
        styles=[
            html.PAGE_STYLE
            + _heatmap.STYLE
            + _STYLE
            + (_GROWTH_STYLE if record.matrix.grows else "")
            + _choosing(shown),
            svg.STYLE,
        ],
        record=record,
        headline=(verdict(record), _kind(record)),
        summary=_summary(record),
        explanation=explanation(record) + unjudged(record),
        troubles=[
            (_heatmap.anchor(cell.point), name_of(record.matrix, cell.point), sentence)
            for cell in record.cells
            for sentence in troubles(record, cell)
        ],
        improvements=[*improvements(record), *changed_runs(record)],
        heatmaps=[_heatmap.heatmap(record, figure) for figure in shown],
        shades=range(_heatmap.SHADES),
        cells=drilldown(finished, directory),
        judged=RUN_CHECKS,
        tried=list(describe_coverage(record.tried)) if record.tried else [],
        tried_cells=[(name_of(record.matrix, cell.point), cell) for cell in record.tried.cells] if record.tried else [],
        not_taken=record.tried.all_cells["branches"]["not_taken"] if record.tried else [],
        nights=nights,
        drawn=drawn,
        night_columns=_trend.night_columns(drawn),
        night_rows=_trend.night_rows(drawn, record),
        changed=list(_changed(record)),
        trends=[(figure, _trend.trend(drawn, record, figure)) for figure in shown] if len(drawn) > 1 else [],
        series=series_of(record),
        picture=Markup(draw(record)),  # noqa: S704 - it escapes text from outside
        growth=list(_growth_table.growth_tables(record)),
        growth_table=_growth_table,
        growth_picture=Markup(draw_growth(record)) if record.matrix.grows else None,  # noqa: S704 - as above
    )


def _changed(record: MatrixRecord) -> Iterator[tuple[str, ChangedRuns, str]]:
    """Yield an entry for each cell with changed runs. An entry contains the name of the cell, the changed runs, and a
    command that compares one of these runs in detail.
    """
    against = record.against
    for changed in against.changed_runs if against else ():
        before = against.baseline_commit if against else None
        seed = min(changed.first, key=lambda each: each.at_s or 0.0).seed if changed.first else changed.seeds[0]
        command = f"ucp-harness bisect {scenario_file(changed.point)} --seed {seed} --good {before or 'COMMIT'}"
        yield name_of(record.matrix, changed.point), changed, command


def _choosing(shown: list[_heatmap.HeatmapFigure]) -> str:
    """Return the CSS that shows the heatmaps of the chosen numeric result and hides the others. On paper, all heatmaps
    are visible.
    """
    others = [
        f"main:has(#show-{figure.metric.name}:checked) {{}} .figure:not(.of-{figure.metric.name})" for figure in shown
    ]
    on_screen, always = (",\n".join(rule.format(place) for rule in others) for place in ("", ".trend"))
    return f"@media screen {{\n{on_screen} {{ display: none; }}\n}}\n{always} {{ display: none; }}\n"


def _kind(record: MatrixRecord) -> str:
    """Return the CSS class of the page, which depends on the result of the matrix. If the matrix was interrupted, the
    class is never "holds".
    """
    if record.outcome == "interrupted":
        return "violated" if record.failed or any(cell.violated for cell in record.cells) else "unknown"
    return {0: "holds", CANNOT_HERE: "unknown"}.get(record.exit_status, "violated")


def _summary(record: MatrixRecord) -> list[str]:
    matrix = record.matrix
    agents = list(dict.fromkeys(point.agents for point in matrix.points))
    return [
        f"{', '.join(map(str, agents))} agents",
        f"{say_lengths(matrix)} mission",
        f"{len(matrix.loss)} loss rates" if len(matrix.loss) > 1 else f"{text.percent(matrix.loss[0])} loss",
        f"{len(matrix.seed_list)} seeds" if len(matrix.seed_list) > 1 else f"seed {matrix.seed_list[0]}",
        f"backend {', '.join(matrix.backend)}",
        *(program.in_words for program in asked_for(matrix.scenario_at(matrix.points[-1]))),
        f"begun {text.started(record.started_at)}",
    ]
