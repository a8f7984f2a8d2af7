"""Show injected messages in the report: the datagrams that the rogue node (a sender outside the swarm) sent, and how
the agents reacted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.archive.run_record import RogueInjection
from harness.checker.injections import describe_handling, in_words
from harness.present import text

MAX_ROWS = 500


@dataclass(frozen=True, slots=True)
class InjectionRow:
    """A table row about one result of an injection. `message` is the type of the injected message. If the agents
    refused the datagrams, `message` contains their reason instead.
    """

    at: str
    what: str
    detail: str
    message: str
    sent: str
    done: str
    changed: str


@dataclass(frozen=True, slots=True)
class RogueSection:
    """The table of injected messages. `left_out` is the number of rows that the table omits, because it has at most
    `MAX_ROWS` rows.
    """

    rows: list[InjectionRow]
    left_out: int


def section(injections: Sequence[RogueInjection]) -> RogueSection | None:
    """Return the table of injected messages. Return None if no message was injected in the run."""
    rows = [row for injection in injections for row in _rows(injection)]
    return RogueSection(rows[:MAX_ROWS], max(0, len(rows) - MAX_ROWS)) if rows else None


def sentences(injections: Sequence[RogueInjection]) -> list[str]:
    return [in_words(injection) for injection in injections]


def _rows(injection: RogueInjection) -> list[InjectionRow]:
    outcomes = [(of.message, of.sent, describe_handling(of), text.value(of.changed)) for of in injection.messages]
    outcomes += [(f"none: {reason}", count, "refused", "\u2013") for reason, count in injection.refused.items()]
    outcomes += (
        [("any", injection.untraced, "indistinguishable from their originals", "\u2013")] if injection.untraced else []
    )
    begun = (text.duration(injection.at_s), injection.what, injection.detail)
    return [
        InjectionRow(*begun, message, text.value(sent), done, changed)
        for message, sent, done, changed in outcomes or [("\u2013", 0, "nothing sent", "\u2013")]
    ]
