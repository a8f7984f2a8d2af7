"""What the pictures along mission time share: a view that zooming changes, marks pinned to a second, and the axis.

Inside a view one unit across is a mission second, and one down is a pixel; to zoom is to change its viewBox. So shapes
in it stretch, and strokes (`vector-effect` in `timeline.css`) do not. What must not stretch is pinned outside the view.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.archive.run_record import FaultRecord
from harness.present.svg import linear_axis, n

TICK_HEIGHT = 22


@dataclass(frozen=True, slots=True)
class Shade:
    """The network was parted from one mission second to another, and how."""

    start_s: float
    end_s: float
    text: str


def seconds(moment: float) -> str:
    """Mission seconds to the millisecond: 300.25 s."""
    return f"{short(moment)}\u00a0s"


def short(moment: float) -> str:
    return f"{moment:.3f}".rstrip("0").rstrip(".")


def plot(view: Iterable[Markup], pinned: Iterable[Markup], height: float, end_s: float, description: str) -> Markup:
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="plot" role="img" width="100%" height="{h}" aria-label="{desc}">'
        '<svg class="view" width="100%" height="{h}" viewBox="0 0 {end} {h}" preserveAspectRatio="none">{view}</svg>'
        "{pinned}</svg>"
    ).format(
        h=n(height), end=short(end_s), desc=description, view=Markup("").join(view), pinned=Markup("").join(pinned)
    )


def pin(at_s: float, end_s: float, y: float, shape: Markup) -> Markup:
    """The shape with its origin at this second, wherever that is in the view."""
    return Markup('<svg class="pin" data-at="{}" x="{}%" y="{}">{}</svg>').format(
        short(at_s), short(100 * at_s / end_s), n(y), shape
    )


def shaded(shades: Sequence[Shade], faults: Sequence[FaultRecord], height: float) -> Markup:
    """Behind everything: when the network was parted, and a rule where something was done to it or to agents."""
    parts = [
        Markup('<rect class="shade" x="{}" width="{}" height="{}"><title>{}</title></rect>').format(
            short(shade.start_s),
            short(shade.end_s - shade.start_s),
            n(height),
            f"{seconds(shade.start_s)} to {seconds(shade.end_s)}: {shade.text}",
        )
        for shade in shades
    ]
    parts += [
        Markup('<path class="{}" d="M{} 0V{}"><title>{}</title></path>').format(
            "fault" if fault.agents else "change", short(fault.at_s), n(height), told(fault)
        )
        for fault in faults
    ]
    return Markup("").join(parts)


def told(fault: FaultRecord) -> str:
    return f"{seconds(fault.at_s)}: {fault.what[:60]}, {fault.detail[:300]}"


def axis(end_s: float) -> Markup:
    ticks = linear_axis(0.0, end_s, (0.0, 100.0)).ticks
    marks = (
        pin(tick, end_s, 0, Markup('<path d="M0 0v4"/><text y="17" text-anchor="middle">{}</text>').format(short(tick)))
        for tick in ticks
    )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="ticks" width="100%" height="{}" aria-hidden="true">{}</svg>'
    ).format(TICK_HEIGHT, Markup("").join(marks))
