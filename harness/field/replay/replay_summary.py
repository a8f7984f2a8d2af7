"""What came of playing a whole record, for people."""

from collections.abc import Iterator
from itertools import islice

from rich.text import Text

from harness.checker.judgement import times
from harness.checker.steps.deviation import Deviation
from harness.field.replay.agent_record import Record
from harness.field.replay.handler_source import source_of
from harness.field.replay.player import Found
from harness.field.replay.replay_document import verdict
from harness.field.replay.replay_names import Names
from harness.field.replay.terminal_text import shown
from ucp.agent import HANDLERS

HANDLERS_SHOWN = 10
LOST_SHOWN = 5


def head(record: Record) -> Text:
    """Whose record it is, and how much of it there is."""
    lives = f", {record.lives} lives" if record.lives > 1 else ""
    return shown(
        f"agent {record.agent_id}, one of {len(record.header.roster)}: {len(record.entries):,} lines, "
        f"{record.ends_s:,.0f} s of the mission{lives}; {record.path}",
        style="dim",
    )


def summary(record: Record, found: Found, names: Names) -> Iterator[Text]:
    """The first difference in full, what follows counted by handler, and what could not be judged."""
    steps = f"{found.steps:,} handler run{'s' if found.steps != 1 else ''}"
    match verdict(found):
        case "as specified":
            words = "all" if not found.unjudged else "as far as it could be played,"
            yield shown(f"✔ no difference: {steps}, {words} as Algorithms 1 to 20 say", style="green")
        case "not judged":
            yield shown("- nothing could be judged", style="yellow")
        case "deviates":
            yield from _differences(record, found, steps, names)
    if found.unjudged:
        runs = "handler run" if found.unjudged == 1 else "handler runs"
        yield shown(f"- {found.unjudged:,} {runs} could not be judged:", style="yellow")
        for sentence in found.lost[:LOST_SHOWN]:
            yield shown(f"  {sentence}", style="yellow")


def _differences(record: Record, found: Found, steps: str, names: Names) -> Iterator[Text]:
    first = found.first
    assert first is not None, "it deviates"
    count = len(found.deviations)
    yield shown(f"✘ {count:,} difference{'s' if count > 1 else ''} in {steps}; the first:", style="bold red")
    yield shown(f"  line {first.line}, t={first.t:g} s: {title(first)}")
    yield shown(f"  {first.difference(names.of)}", style="red")
    yield shown(f"  ucp-harness replay {record.named} --break {first.line}", style="dim")
    of_handler: dict[str, list[Deviation]] = {}
    for deviation in found.deviations:
        of_handler.setdefault(title(deviation), []).append(deviation)
    if len(of_handler) > 1:
        yield shown("By handler, with the line of the first:")
        for name, deviations in islice(of_handler.items(), HANDLERS_SHOWN):
            yield shown(f"  {name}: {times(len(deviations))}, line {deviations[0].line}, t={deviations[0].t:g} s")


def title(deviation: Deviation) -> str:
    """ "Algorithm 13, receive_request_next_in_sequence (ucp/reconcile.py:130)"."""
    handler = HANDLERS.get(deviation.handler or "")
    if handler is None:
        return "what is no handler of the protocol"
    return f"Algorithm {handler.algorithm}, {handler.name} ({source_of(handler.name)})"
