"""Values as text: for people, for a terminal, and in Markdown."""

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from rich.text import Text

_EPOCH_FROM_US = 1_000_000_000_000_000
"""Block timestamps from here on (2001) are since the Unix epoch; smaller ones are since the start of a virtual run."""
_LAST_EPOCH_US = 253_402_300_799_000_000


def moment(timestamp_us: int) -> str:
    """A block's timestamp, to the millisecond."""
    if _EPOCH_FROM_US <= timestamp_us <= _LAST_EPOCH_US:
        at = datetime.fromtimestamp(timestamp_us // 1_000_000, UTC)
        return f"{at:%Y-%m-%d %H:%M:%S}.{timestamp_us // 1000 % 1000:03d} UTC"
    return f"{timestamp_us / 1_000_000:.3f} s"


def started(text: Any) -> str:
    """An ISO 8601 time without its punctuation, or whatever was written instead."""
    try:
        at = datetime.fromisoformat(str(text))
    except ValueError:
        return value(text)
    return f"{at:%Y-%m-%d %H:%M:%S} {at.tzname() or ''}".rstrip()


def duration(seconds: float) -> str:
    """Mission or wall time, in the unit of everything else: 45 s, 1200 s."""
    return f"{_shortest(seconds)}\u00a0s"


def percent(share: float) -> str:
    """A share of 0 to 1: 12.5 %."""
    return f"{_shortest(100 * share)}\u00a0%"


def value(anything: Any) -> str:
    """Any JSON value in a cell or a tile."""
    if anything is None:
        return "\u2013"
    if isinstance(anything, bool):
        return "yes" if anything else "no"
    if isinstance(anything, int):
        return f"{anything:,}".replace(",", "\u202f") if abs(anything) < 10**30 else "beyond counting"
    if isinstance(anything, float):
        return _shortest(anything)
    return anything if isinstance(anything, str) else json.dumps(anything, ensure_ascii=False)


def label(key: str) -> str:
    """A key of a JSON document as a label: real_time_factor -> real time factor."""
    return key.replace("_", " ")


def _shortest(number: float) -> str:
    return f"{number:.2f}".rstrip("0").rstrip(".") if abs(number) < 1e12 else f"{number:g}"


def row(fields: Iterable[str]) -> str:
    """Of a table; the fields are Markdown themselves."""
    return f"| {' | '.join(fields)} |"


def escaped(text: str) -> str:
    """As words on one line, whatever they hold."""
    line = " ".join(text.splitlines())
    return "".join(f"\\{character}" if character in "\\`*_{}[]<>#|~&" else character for character in line)


_CONTROL = dict.fromkeys((*range(32), *range(127, 160)), "�")


def shown(words: str, style: str = "") -> Text:
    """One line; what no reader could see is shown as a replacement character."""
    return Text(words.translate(_CONTROL), style=style)
