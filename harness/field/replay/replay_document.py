"""What `ucp-harness replay --json` prints, schema `ucp-replay/1`. Keys are added, never removed or renamed."""

from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.checker.steps.deviation import Deviation
from harness.field.replay.agent_record import Record
from harness.field.replay.handler_source import source_of
from harness.field.replay.player import Found
from harness.field.replay.replay_names import Names
from ucp.agent import HANDLERS

SCHEMA: Literal["ucp-replay/1"] = "ucp-replay/1"
MAX_DIFFERENCES = 1000
"""More of one record are counted."""

Verdict = Literal["as specified", "deviates", "not judged"]


class DifferenceRecord(BaseModel):
    """A step that is not the reference's; without `algorithm`, `handler` and `source` it is no handler's of the 20."""

    line: int
    t: Annotated[float, Field(description="Mission seconds, by the agent's record.")]
    algorithm: int | None
    handler: str | None
    source: Annotated[str | None, Field(description="Where the reference's handler begins, such as ucp/commit.py:101.")]
    difference: Annotated[str, Field(description='"it ...; it should have ...", in words.')]


class ReplayedRecord(BaseModel):
    """Of one record `steps` handler runs were compared, and `unjudged` could not be, because of what the list says."""

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
    """One element for each record that was played, in the order of the agents."""

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
