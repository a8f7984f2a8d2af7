"""Draw charts below the timeline: lengths of chains, numbers of copies of blocks, and an endless cycle of the agents.

All pictures over mission time share the zoomable view, the marks, and the axis of this module. In a view, one
horizontal unit is a mission second and one vertical unit is a pixel. Zooming changes the viewBox of the view. Zooming
stretches shapes in the view, but not strokes (`vector-effect` in `timeline.css`). Marks that must keep their shape are
drawn outside the view with `pin`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil

from markupsafe import Markup

from harness.archive.replication import ReplicationFigures
from harness.archive.run_record import Cycle, FaultRecord
from harness.checker.recurring_cycles import findings, in_words
from harness.present import text
from harness.present.svg import filled, linear_axis, n

TICK_HEIGHT = 22


@dataclass(frozen=True, slots=True)
class PartitionShade:
    """An interval of mission time in which the network is partitioned, with a description of the partition."""

    start_s: float
    end_s: float
    text: str


def format_seconds(moment: float) -> str:
    """Return mission seconds with three decimals, for example "300.25 s"."""
    return f"{format_number(moment)}\u00a0s"


def format_number(moment: float) -> str:
    return f"{moment:.3f}".rstrip("0").rstrip(".")


def plot(view: Iterable[Markup], pinned: Iterable[Markup], height: float, end_s: float, description: str) -> Markup:
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="plot" role="img" width="100%" height="{h}" aria-label="{desc}">'
        '<svg class="view" width="100%" height="{h}" viewBox="0 0 {end} {h}" preserveAspectRatio="none">{view}</svg>'
        "{pinned}</svg>"
    ).format(
        h=n(height),
        end=format_number(end_s),
        desc=description,
        view=Markup("").join(view),
        pinned=Markup("").join(pinned),
    )


def pin(at_s: float, end_s: float, y: float, shape: Markup) -> Markup:
    """Draw a shape at this mission second outside of the zoomed view. The shape keeps its size when the user zooms."""
    return Markup('<svg class="pin" data-at="{}" x="{}%" y="{}">{}</svg>').format(
        format_number(at_s), format_number(100 * at_s / end_s), n(y), shape
    )


def draw_background(shades: Sequence[PartitionShade], faults: Sequence[FaultRecord], height: float) -> Markup:
    """Draw the background of the picture: coloured areas for partitions, and vertical lines for network changes and
    faults.
    """
    parts = [
        Markup('<rect class="shade" x="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            format_number(shade.start_s),
            format_number(shade.end_s - shade.start_s),
            n(height),
            f"{format_seconds(shade.start_s)} to {format_seconds(shade.end_s)}: {shade.text}",
        )
        for shade in shades
    ]
    parts += [
        Markup('<path class="{}" d="M{} 0V{}"><title>{}</title></path>').format(
            "fault" if fault.agents else "change", format_number(fault.at_s), n(height), fault_text(fault)
        )
        for fault in faults
    ]
    return Markup("").join(parts)


def fault_text(fault: FaultRecord) -> str:
    return f"{format_seconds(fault.at_s)}: {fault.what[:60]}, {fault.detail[:300]}"


def axis(end_s: float) -> Markup:
    ticks = linear_axis(0.0, end_s, (0.0, 100.0)).ticks
    marks = (
        pin(
            tick,
            end_s,
            0,
            Markup('<path d="M0 0v4"/><text y="17" text-anchor="middle">{}</text>').format(format_number(tick)),
        )
        for tick in ticks
    )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="ticks" width="100%" height="{}" aria-hidden="true">{}</svg>'
    ).format(TICK_HEIGHT, Markup("").join(marks))


HEIGHT = 72
MAX_MOMENTS = 600

_TOP, _BOTTOM = 14, 4  # room above the highest value and below 0

Figure = Callable[[ReplicationFigures], float | None]


@dataclass(frozen=True, slots=True)
class TimelineChart:
    """A chart with its legend. Each entry of `lines` contains a sample of a line and the meaning of this line."""

    name: str
    lines: list[tuple[Markup, str]]
    drawing: Markup


_CHARTS: tuple[tuple[str, tuple[tuple[str, Figure], ...]], ...] = (
    (
        "blocks in chain",
        (("longest", lambda spread: spread.longest_chain), ("mutual", lambda spread: spread.mutual_chain)),
    ),
    ("distinct chains", (("chains", lambda spread: spread.distinct_chains),)),
    ("copies in chains", (("mean", lambda spread: spread.copies_mean), ("fewest", lambda spread: spread.copies_min))),
)
_LINE_CLASSES = ("broken", "whole")
"""CSS classes of the two lines in a chart. If a chart has only one line, the line has the last class."""


def draw(
    spreads: Sequence[ReplicationFigures], faults: Sequence[FaultRecord], shades: Sequence[PartitionShade], end_s: float
) -> list[TimelineChart]:
    """Return a chart for each group of numeric results. `spreads` contains the numbers of copies of blocks over time,
    with at least one entry.
    """
    moments = thin_states(spreads, end_s)
    behind = draw_background(shades, faults, HEIGHT)
    return [_chart(name, figures, moments, behind, end_s) for name, figures in _CHARTS]


def thin_states(spreads: Sequence[ReplicationFigures], end_s: float) -> Sequence[ReplicationFigures]:
    """Remove states from a long list, without a visible change of the picture that shows the whole run. For each column
    of the picture, the result contains two states: the last one, and the one with the shortest mutual chain, which is
    the common beginning of all chains.
    """
    if len(spreads) <= MAX_MOMENTS:
        return spreads
    kept: dict[int, tuple[ReplicationFigures, ReplicationFigures]] = {}
    for spread in spreads:
        place = int(spread.at_s / end_s * MAX_MOMENTS / 2)
        worst = min(kept[place][0], spread, key=lambda moment: moment.mutual_chain) if place in kept else spread
        kept[place] = worst, spread
    return [spread for pair in kept.values() for spread in dict.fromkeys(pair)]


def _chart(
    name: str,
    figures: Sequence[tuple[str, Figure]],
    moments: Sequence[ReplicationFigures],
    behind: Markup,
    end_s: float,
) -> TimelineChart:
    highest = max(
        (value for _, figure in figures for moment in moments if (value := figure(moment)) is not None), default=0
    )
    classes = _LINE_CLASSES[-len(figures) :]
    per_px = max(highest, 1) / (HEIGHT - _TOP - _BOTTOM)
    lines = [
        Markup('<path class="line {}" d="{}"/>').format(css_class, _steps(moments, figure, per_px, end_s))
        for css_class, (_, figure) in zip(classes, figures, strict=True)
    ]
    until = [*(moment.at_s for moment in moments[1:]), end_s]
    tips = [
        filled(
            '<rect class="tip" x="{}" width="{}" height="{}"><title>{}</title></rect>',
            format_number(moment.at_s),
            format_number(until_s - moment.at_s),
            HEIGHT,
            _tip(moment, figures, name),
        )
        for moment, until_s in zip(moments, until, strict=True)
        if until_s > moment.at_s
    ]
    base = Markup('<path class="base" d="M0 {}H{}"/>').format(n(HEIGHT - _BOTTOM), format_number(end_s))
    scale = Markup('<text class="scale" x="4" y="11">{}</text>').format(text.value(highest))
    at_end = ", ".join(f"{what} {text.value(figure(moments[-1]))}" for what, figure in figures)
    description = f"{name} over mission time: maximum {text.value(highest)}; at the end {at_end}"
    return TimelineChart(
        name,
        [
            (
                Markup(
                    '<svg width="34" height="16" aria-hidden="true"><path class="line {}" d="M1 8h32"/></svg>'
                ).format(css_class),
                what,
            )
            for css_class, (what, _) in zip(classes, figures, strict=True)
        ],
        plot([behind, base, *lines, *tips], [scale], HEIGHT, end_s, description),
    )


def _steps(moments: Sequence[ReplicationFigures], figure: Figure, per_px: float, end_s: float) -> str:
    """Return a line with steps as an SVG path. The line starts at the first known value."""
    path = ""
    last: float | None = None
    for moment in moments:
        value = figure(moment)
        if value is not None and value != last:
            y = n(HEIGHT - _BOTTOM - value / per_px)
            path += f"H{format_number(moment.at_s)}V{y}" if path else f"M{format_number(moment.at_s)} {y}"
            last = value
    return f"{path}H{format_number(end_s)}" if path else ""


def _tip(moment: ReplicationFigures, figures: Sequence[tuple[str, Figure]], name: str) -> str:
    values = ", ".join(f"{what} {text.value(figure(moment))}" for what, figure in figures)
    return f"from {format_seconds(moment.at_s)}: {name}: {values}"


CYCLE_HEIGHT = 34
MAX_ROUNDS = 400
"""Maximum number of brackets that mark repetitions. If there are more repetitions, only the last ones get brackets,
because readers could not distinguish all of them.
"""
MOST_ROUNDS = 1_000_000
MAX_TEXT = 1000

_CYCLE_TOP, _CYCLE_BOTTOM = 3, 12
_TEXT = 28


def cycle_chart(cycle: Cycle, end_s: float) -> TimelineChart:
    """Draw an endless cycle of the agents. The run ends at mission second `end_s`."""
    start_s = max(0.0, min(cycle.since_s, end_s))
    period_s = cycle.period_s if cycle.period_s is not None and cycle.period_s > 0 else end_s - start_s
    fault_text = "; ".join(f"agent {finding.agent_id}, {finding.detail}" for finding in findings(cycle))[:MAX_TEXT]
    rounds = ceil(min((end_s - start_s) / period_s, MOST_ROUNDS)) if period_s > 0 else 0
    starts = [start_s + number * period_s for number in range(max(0, rounds - MAX_ROUNDS), rounds)]
    brackets = [_bracket(at_s, min(at_s + period_s, end_s)) for at_s in starts]
    tip = Markup('<rect class="tip" x="{}" width="{}" height="{}"><title>{}</title></rect>').format(
        format_number(start_s), format_number(end_s - start_s), CYCLE_HEIGHT, f"{in_words(cycle)}. {fault_text}"
    )
    label = (
        f"every {cycle.period_s:.4g} s since {start_s:.0f} s" if cycle.period_s else f"inactive since {start_s:.0f} s"
    )
    anchor = "end" if start_s > end_s / 2 else "start"
    text = Markup('<text class="scale" text-anchor="{}">{}</text>').format(anchor, label)
    return TimelineChart(
        "repeats a cycle" if cycle.period_s else "hangs",
        [],
        plot(
            [*brackets, tip],
            [pin(start_s, end_s, _TEXT, text)],
            CYCLE_HEIGHT,
            end_s,
            f"{in_words(cycle)}. {fault_text}",
        ),
    )


def _bracket(start_s: float, end_s: float) -> Markup:
    return Markup('<path class="round" d="M{} {}V{}H{}V{}"/>').format(
        format_number(start_s), _CYCLE_TOP, _CYCLE_BOTTOM, format_number(end_s), _CYCLE_TOP
    )
