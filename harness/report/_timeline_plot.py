"""Provide the common parts of all pictures over mission time: the zoomable view, marks, and the axis.

In a view, one horizontal unit is a mission second and one vertical unit is a pixel. Zooming changes the viewBox of the
view. Zooming stretches shapes in the view, but not strokes (`vector-effect` in `timeline.css`). Marks that must keep
their shape are drawn outside the view with `pin`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.archive.run_record import FaultRecord
from harness.present.svg import linear_axis, n

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
    """Draw a shape at this mission second. The shape keeps its size when the user zooms."""
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
