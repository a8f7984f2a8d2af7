"""What the rogue node sent, and what the agents did with it, as the page says it."""

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from harness.archive.record import RogueInjection
from harness.archive.result import listing
from harness.checker.injections import done_with, in_words
from harness.present import words

MAX_ROWS = 500


@dataclass(frozen=True, slots=True)
class Row:
    """`message` is a type of message, or says why agents refuse the datagrams."""

    at: str
    what: str
    detail: str
    message: str
    sent: str
    done: str
    changed: str


@dataclass(frozen=True, slots=True)
class Section:
    """`left_out` says how many rows there were no room for."""

    rows: list[Row]
    left_out: int


def section(result: dict[str, Any]) -> Section | None:
    """None if no rogue node was on the air, or the record says nothing of it that can be read."""
    rows = [row for injection in _injections(result) for row in _rows(injection)]
    return Section(rows[:MAX_ROWS], max(0, len(rows) - MAX_ROWS)) if rows else None


def sentences(result: dict[str, Any]) -> list[str]:
    """One for each injection."""
    return [in_words(injection) for injection in _injections(result)]


def _injections(result: dict[str, Any]) -> list[RogueInjection]:
    try:
        return [RogueInjection.model_validate(injection) for injection in listing(result, "rogue")]
    except ValidationError:
        return []


def _rows(injection: RogueInjection) -> list[Row]:
    outcomes = [(of.message, of.sent, done_with(of), words.value(of.changed)) for of in injection.messages]
    outcomes += [(f"none: {reason}", count, "refused", "\u2013") for reason, count in injection.refused.items()]
    outcomes += [("any", injection.untraced, "not told from their originals", "\u2013")] if injection.untraced else []
    begun = (words.duration(injection.at_s), injection.what, injection.detail)
    return [
        Row(*begun, message, words.value(sent), done, changed)
        for message, sent, done, changed in outcomes or [("\u2013", 0, "nothing sent", "\u2013")]
    ]
