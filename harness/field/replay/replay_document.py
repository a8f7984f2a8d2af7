"""Define the result of a replay as the JSON document `ucp-replay/1`, and summarise it for users."""

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.text import Text

from harness.checker.judgement import times
from harness.checker.steps.deviation import StepDeviation
from harness.field.replay._agent_record import RecordedTrace
from harness.field.replay._player import ReplayResult
from harness.field.replay.breakpoints import source_of
from harness.field.replay.replay_names import ReplayNames
from harness.present.text import shown
from ucp.agent import HANDLERS

SCHEMA: Literal["ucp-replay/1"] = "ucp-replay/1"
MAX_DIFFERENCES = 1000
"""Maximum number of differences that are listed for each record. Further differences are only counted."""

Verdict = Literal["as specified", "deviates", "not judged"]


class DifferenceRecord(BaseModel):
    """A step that differs from the reference core. `algorithm`, `handler` and `source` are null if the step is no run
    of one of the 20 handlers.
    """

    line: int
    t: Annotated[float, Field(description="Mission seconds, by the agent's record.")]
    algorithm: int | None
    handler: str | None
    source: Annotated[str | None, Field(description="Where the reference's handler begins, such as ucp/commit.py:101.")]
    difference: Annotated[str, Field(description='"it ...; it should have ...", in words.')]


class ReplayedRecord(BaseModel):
    """The replay of one record. `steps` counts the handler runs that were compared. `unjudged` counts all other handler
    runs, and `unjudged_because` contains the reasons.
    """

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


def document(records: Iterable[ReplayedRecord]) -> dict[str, object]:
    return ReplayDocument(records=list(records)).model_dump(by_alias=True)


def verdict(result: ReplayResult) -> Verdict:
    """Return the verdict on a replay. The verdict on a record without compared steps is "not judged", never "as
    specified".
    """
    if result.deviations:
        return "deviates"
    return "as specified" if result.steps else "not judged"


def replayed(record: RecordedTrace, result: ReplayResult, names: ReplayNames) -> ReplayedRecord:
    deviations = result.deviations
    return ReplayedRecord(
        record=str(record.path),
        agent_id=record.agent_id,
        verdict=verdict(result),
        steps=result.steps,
        unjudged=result.unjudged,
        unjudged_because=result.lost,
        problems=record.problems,
        differences=[_difference(deviation, names) for deviation in deviations[:MAX_DIFFERENCES]],
        differences_in_all=len(deviations),
        by_handler=dict(Counter(deviation.handler or "" for deviation in deviations).most_common()),
    )


def _difference(deviation: StepDeviation, names: ReplayNames) -> DifferenceRecord:
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


def header_text(record: RecordedTrace) -> Text:
    """Return a line with the agent and the length of its record."""
    incarnations = f", {record.incarnations} lives" if record.incarnations > 1 else ""
    return shown(
        f"agent {record.agent_id}, one of {len(record.header.roster)}: {len(record.entries):,} lines, "
        f"{record.end_s:,.0f} s of the mission{incarnations}; {record.path}",
        style="dim",
    )


def summary(record: RecordedTrace, result: ReplayResult, names: ReplayNames) -> Iterator[Text]:
    """Yield text about the first difference in detail, a list of the other differences by handler, and the reasons why
    steps were not compared.
    """
    steps = f"{result.steps:,} handler run{'s' if result.steps != 1 else ''}"
    match verdict(result):
        case "as specified":
            scope = "all" if not result.unjudged else "the steps that could be played"
            yield shown(f"✔ no difference: {steps}, {scope} follow Algorithms 1 to 20", style="green")
        case "not judged":
            yield shown("- nothing could be judged", style="yellow")
        case "deviates":
            yield from _differences(record, result, steps, names)
    if result.unjudged:
        runs = "handler run" if result.unjudged == 1 else "handler runs"
        yield shown(f"- {result.unjudged:,} {runs} could not be judged:", style="yellow")
        for sentence in result.lost[:LOST_SHOWN]:
            yield shown(f"  {sentence}", style="yellow")


def _differences(record: RecordedTrace, result: ReplayResult, steps: str, names: ReplayNames) -> Iterator[Text]:
    first = result.first
    assert first is not None, "it deviates"
    count = len(result.deviations)
    yield shown(f"✘ {count:,} difference{'s' if count > 1 else ''} in {steps}; the first:", style="bold red")
    yield shown(f"  line {first.line}, t={first.t:g} s: {title(first)}")
    yield shown(f"  {first.difference(names.of)}", style="red")
    yield shown(f"  ucp-harness replay {record.argument} --break {first.line}", style="dim")
    of_handler: dict[str, list[StepDeviation]] = {}
    for deviation in result.deviations:
        of_handler.setdefault(title(deviation), []).append(deviation)
    if len(of_handler) > 1:
        yield shown("By handler, with the line of the first:")
        for name, deviations in islice(of_handler.items(), HANDLERS_SHOWN):
            yield shown(f"  {name}: {times(len(deviations))}, line {deviations[0].line}, t={deviations[0].t:g} s")


def title(deviation: StepDeviation) -> str:
    """Return the title of a deviation, such as "Algorithm 13, receive_request_next_in_sequence
    (ucp/reconcile.py:130)".
    """
    handler = HANDLERS.get(deviation.handler or "")
    if handler is None:
        return "an unknown handler"
    return f"Algorithm {handler.algorithm}, {handler.name} ({source_of(handler.name)})"
