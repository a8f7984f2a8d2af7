"""Convert values to text for readers, for a terminal, and for Markdown."""

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from rich.text import Text

_EPOCH_FROM_US = 1_000_000_000_000_000
"""The smallest timestamp, in microseconds, that counts as time since the Unix epoch. It lies in the year 2001. Smaller
timestamps are times since the start of a simulated run.
"""
_LAST_EPOCH_US = 253_402_300_799_000_000
MAX_WORD = 120
"""Maximum number of characters of a misspelt word that are compared with the allowed words."""


def moment(timestamp_us: int) -> str:
    """Return a block's timestamp as text, with milliseconds."""
    if _EPOCH_FROM_US <= timestamp_us <= _LAST_EPOCH_US:
        at = datetime.fromtimestamp(timestamp_us // 1_000_000, UTC)
        return f"{at:%Y-%m-%d %H:%M:%S}.{timestamp_us // 1000 % 1000:03d} UTC"
    return f"{timestamp_us / 1_000_000:.3f} s"


def started(text: Any) -> str:
    """Return an ISO 8601 time as date, time and zone. Any other text is returned unchanged."""
    try:
        at = datetime.fromisoformat(str(text))
    except ValueError:
        return value(text)
    return f"{at:%Y-%m-%d %H:%M:%S} {at.tzname() or ''}".rstrip()


def duration(seconds: float) -> str:
    """Return a number of seconds as text, such as "45 s" or "1200 s"."""
    return f"{_shortest(seconds)}\u00a0s"


def percent(share: float) -> str:
    """Return a share from 0 to 1 as text, such as "12.5 %"."""
    return f"{_shortest(100 * share)}\u00a0%"


def value(anything: Any) -> str:
    """Return a JSON value as text for a table cell."""
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
    """Convert a JSON key to a label: "real_time_factor" becomes "real time factor"."""
    return key.replace("_", " ")


def _shortest(number: float) -> str:
    return f"{number:.2f}".rstrip("0").rstrip(".") if abs(number) < 1e12 else f"{number:g}"


def row(fields: Iterable[str]) -> str:
    """Return a row of a Markdown table. The fields may contain Markdown."""
    return f"| {' | '.join(fields)} |"


def escaped(text: str) -> str:
    """Return the text as Markdown that shows it literally on one line."""
    line = " ".join(text.splitlines())
    return "".join(f"\\{character}" if character in "\\`*_{}[]<>#|~&" else character for character in line)


_CONTROL = dict.fromkeys((*range(32), *range(127, 160)), "�")


def shown(words: str, style: str = "") -> Text:
    """Return the text as one line. Control characters are replaced by visible characters."""
    return Text(words.translate(_CONTROL), style=style)


def did_you_mean(word: object, allowed: Iterable[object]) -> str:
    """Return a hint with the most similar allowed word, such as "; did you mean `loss_15`?". Return an empty text if no
    allowed word is similar.
    """
    from difflib import get_close_matches  # imported late, because only errors need it

    nearest = get_close_matches(str(word)[:MAX_WORD], map(str, allowed), n=1)
    return f"; did you mean `{nearest[0]}`?" if nearest else ""
