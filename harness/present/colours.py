"""Choose a colour for each agent. The colours differ for any colour vision, in light and in dark mode.

The first eight colours are those of Okabe and Ito (https://jfly.uni-koeln.de/color/), with grey in place of black.
Agents 9 to 16 have lighter colours of the same hues, agents 17 to 24 darker ones, and agents 25 to 32 lighter ones with
a dashed outline. After 32 agents the colours repeat. No picture relies on colour alone: every box also names its agent.
"""

from collections.abc import Iterable
from dataclasses import dataclass

_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_OKABE_ITO = (
    (86, 180, 233),  # sky blue
    (230, 159, 0),  # orange
    (0, 158, 115),  # bluish green
    (240, 228, 66),  # yellow
    (204, 121, 167),  # reddish purple
    (0, 114, 178),  # blue
    (213, 94, 0),  # vermillion
    (160, 160, 160),  # grey
)

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class AgentColours:
    """The colours for an agent's blocks, in the form `#rrggbb`."""

    fill: str
    stroke: str
    text: str
    dashed: bool = False


def inks(agent_ids: Iterable[int]) -> dict[int, AgentColours]:
    """Return the colour of each agent. The colours depend only on the set of agents."""
    return {agent_id: _ink(position) for position, agent_id in enumerate(sorted(set(agent_ids)))}


def ramp(first: Rgb, last: Rgb, steps: int) -> list[AgentColours]:
    """Return `steps` colours that change gradually from `first` to `last`. The first and the last colour should differ
    in lightness.
    """
    fills = [_mixed(first, last, step / (steps - 1)) for step in range(steps)]
    return [AgentColours(fill, fill, _text_on(fill)) for fill in fills]


def contrast(first: str, second: str) -> float:
    """Return the contrast ratio of two colours as WCAG 2 defines it, from 1 to 21."""
    dark, light = sorted((_luminance(first), _luminance(second)))
    return (light + 0.05) / (dark + 0.05)


def _ink(position: int) -> AgentColours:
    hue = _OKABE_ITO[position % len(_OKABE_ITO)]
    variant = position // len(_OKABE_ITO) % 4
    if variant == 2:
        fill, stroke = _mixed(hue, _BLACK, 0.55), _mixed(hue, _WHITE, 0.3)
    elif variant == 0:
        fill, stroke = _hex(hue), _mixed(hue, _BLACK, 0.35)
    else:
        fill, stroke = _mixed(hue, _WHITE, 0.72), _mixed(hue, _BLACK, 0.35)
    return AgentColours(fill, stroke, _text_on(fill), dashed=variant == 3)


def _text_on(fill: str) -> str:
    return max(("#111111", "#ffffff"), key=lambda ink: contrast(ink, fill))


def _mixed(colour: Rgb, into: Rgb, share: float) -> str:
    red, green, blue = (round(start + (end - start) * share) for start, end in zip(colour, into, strict=True))
    return _hex((red, green, blue))


def _hex(colour: Rgb) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue
