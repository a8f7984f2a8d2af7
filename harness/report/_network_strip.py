"""Draw the network conditions over mission time: partitions, losses, and a tick for each fault.

Horizontal positions are percentages of the picture's width. The picture therefore fits any screen, and the text in it
is never scaled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from harness.present import text as words
from harness.present.svg import linear_axis
from harness.report._timeline_plot import format_number

_LANE = 24


@dataclass(frozen=True, slots=True)
class ConditionSpan:
    """An interval of mission time in which a network condition did not change."""

    from_s: float
    to_s: float
    text: str
    level: float = 1.0
    """Height of the filled part of the row, as a share of the row's height from 0 to 1."""


def steps(changes: Sequence[tuple[float, str, float]], end_s: float) -> list[ConditionSpan]:
    """Convert changes of a network condition to intervals. A change is a tuple (at_s, text, level), and its level
    applies until the next change. A change to level 0 gives no interval.
    """
    spans: list[ConditionSpan] = []
    in_time = sorted(changes, key=lambda change: change[0])
    for number, (at_s, text, level) in enumerate(in_time):
        until = in_time[number + 1][0] if number + 1 < len(in_time) else end_s
        if level > 0 and 0 <= at_s < min(until, end_s):
            spans.append(ConditionSpan(at_s, min(until, end_s), text, min(level, 1.0)))
    return spans


def draw(lanes: Sequence[tuple[str, list[ConditionSpan]]], ticks: Sequence[tuple[float, str]], end_s: float) -> Markup:
    """Draw the rows of the picture from top to bottom. `ticks` contains a pair (at_s, text) for each fault."""
    parts: list[Markup] = []
    for number, (name, spans) in enumerate(lanes):
        parts.append(
            Markup('<rect class="lane" y="{}" width="100%" height="{}"><title>{}</title></rect>').format(
                number * (_LANE + 4), _LANE, name
            )
        )
        parts += [_span(name, span, number * (_LANE + 4), end_s) for span in spans]
    height = len(lanes) * (_LANE + 4)
    for at_s, text in ticks:
        if 0 <= at_s <= end_s:
            parts.append(
                Markup('<line class="tick" x1="{x}" x2="{x}" y2="{height}"><title>{text}</title></line>').format(
                    x=_share(at_s, end_s), height=height, text=text
                )
            )
    for tick in linear_axis(0.0, end_s, (0.0, 100.0)).ticks:
        anchor = "end" if tick > 0.95 * end_s else "middle" if tick else "start"
        parts.append(
            Markup('<text class="axis" x="{}" y="{}" text-anchor="{}">{}</text>').format(
                _share(tick, end_s), height + 14, anchor, format_number(tick)
            )
        )
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" class="strip" role="img" width="100%" height="{}"'
        ' aria-label="The network over mission time">{}</svg>'
    ).format(height + 20, Markup("").join(parts))


def _span(lane: str, span: ConditionSpan, y: float, end_s: float) -> Markup:
    """Draw an interval as a nested <svg> element. This element cuts off a text that is too long for the interval."""
    filled = max(2.0, _LANE * span.level)
    return Markup(
        '<svg x="{}" y="{}" width="{}" height="{}"><title>{}</title><rect class="span" y="{:.1f}" width="100%"'
        ' height="{:.1f}"/><text x="6" y="16">{}</text></svg>'
    ).format(
        _share(span.from_s, end_s),
        y,
        _share(span.to_s - span.from_s, end_s),
        _LANE,
        f"{lane}: {span.text}, {words.duration(span.from_s)} to {words.duration(span.to_s)}",
        _LANE - filled,
        filled,
        span.text,
    )


def _share(format_seconds: float, end_s: float) -> str:
    return f"{100 * format_seconds / end_s:.3f}%"
