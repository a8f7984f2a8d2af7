"""The result of a replay: the document `ucp-replay/1`, and a summary for people."""

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.text import Text

from harness.checker.judgement import times
from harness.checker.steps.deviation import Deviation
from harness.field.replay._agent_record import Record
from harness.field.replay._player import Found
from harness.field.replay.breakpoints import source_of
from harness.field.replay.replay_names import Names
from harness.present.text import shown
from ucp.agent import HANDLERS

SCHEMA: Literal["ucp-replay/1"] = "ucp-replay/1"
MAX_DIFFERENCES = 1000
"""Maximum number of listed differences per record. Further ones are only counted."""

Verdict = Literal["as specified", "deviates", "not judged"]


class DifferenceRecord(BaseModel):
    """A step that differs from the reference core. `algorithm`, `handler` and `source` are null if it is none of the 20
    handlers."""

    line: int
    t: Annotated[float, Field(description="Mission seconds, by the agent's record.")]
    algorithm: int | None
    handler: str | None
    source: Annotated[str | None, Field(description="Where the reference's handler begins, such as ucp/commit.py:101.")]
    difference: Annotated[str, Field(description='"it ...; it should have ...", in words.')]


class ReplayedRecord(BaseModel):
    """The replay of one record. `steps` counts the compared handler runs, and `unjudged` the others. `unjudged_because`
    has the reasons."""

    record: Annotated[str, Field(description="The file, or the first of the files.")]
    agent_id: int
    verdict: Verdict
    steps: int
    unjudged: int
    unjudged_because: list[str]
    problems: Annotated[list[str], Field(description="What is damaged or left out, a sentence each.")]
    differences: Annotated[list[DifferenceRecord], Field(description=f"In order; the first {MAX_DIFFERENCES}.")]
    differences_in_all: int
    by_handler: dict[str, int]


class ReplayDocument(BaseModel):
    """The result of a replay. `records` has one element per record, in the order of the agents."""

    model_config = ConfigDict(populate_by_name=True)

    schema_: Annotated[Literal["ucp-replay/1"], Field(alias="schema")] = SCHEMA
    records: list[ReplayedRecord]


def document(records: Iterable[ReplayedRecord]) -> dict[str, Any]:
    return ReplayDocument(records=list(records)).model_dump(by_alias=True)


def verdict(found: Found) -> Verdict:
    """What it comes to; what could not be judged is never as specified."""
    if found.deviations:
        return "deviates"
    return "as specified" if found.steps else "not judged"


def replayed(record: Record, found: Found, names: Names) -> ReplayedRecord:
    deviations = found.deviations
    return ReplayedRecord(
        record=str(record.path),
        agent_id=record.agent_id,
        verdict=verdict(found),
        steps=found.steps,
        unjudged=found.unjudged,
        unjudged_because=found.lost,
        problems=record.problems,
        differences=[_difference(deviation, names) for deviation in deviations[:MAX_DIFFERENCES]],
        differences_in_all=len(deviations),
        by_handler=dict(Counter(deviation.handler or "" for deviation in deviations).most_common()),
    )


def _difference(deviation: Deviation, names: Names) -> DifferenceRecord:
    handler = HANDLERS.get(deviation.handler or "")
    return DifferenceRecord(
        line=deviation.line,
        t=deviation.t,
        algorithm=None if handler is None else handler.algorithm,
        handler=None if handler is None else handler.name,
        source=None if handler is None else source_of(handler.name),
        difference=deviation.difference(names.of),
    )


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
            words = "all" if not found.unjudged else "the steps that could be played"
            yield shown(f"✔ no difference: {steps}, {words} follow Algorithms 1 to 20", style="green")
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
        return "an unknown handler"
    return f"Algorithm {handler.algorithm}, {handler.name} ({source_of(handler.name)})"
