"""What the rogue node sent, and what the agents did with it, as the page says it."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.archive.run_record import RogueInjection
from harness.checker.injections import done_with, in_words
from harness.present import text

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


def section(injections: Sequence[RogueInjection]) -> Section | None:
    """None if no rogue node was on the air, or the run's record says nothing of it."""
    rows = [row for injection in injections for row in _rows(injection)]
    return Section(rows[:MAX_ROWS], max(0, len(rows) - MAX_ROWS)) if rows else None


def sentences(injections: Sequence[RogueInjection]) -> list[str]:
    """One for each injection."""
    return [in_words(injection) for injection in injections]


def _rows(injection: RogueInjection) -> list[Row]:
    outcomes = [(of.message, of.sent, done_with(of), text.value(of.changed)) for of in injection.messages]
    outcomes += [(f"none: {reason}", count, "refused", "\u2013") for reason, count in injection.refused.items()]
    outcomes += (
        [("any", injection.untraced, "indistinguishable from their originals", "\u2013")] if injection.untraced else []
    )
    begun = (text.duration(injection.at_s), injection.what, injection.detail)
    return [
        Row(*begun, message, text.value(sent), done, changed)
        for message, sent, done, changed in outcomes or [("\u2013", 0, "nothing sent", "\u2013")]
    ]
