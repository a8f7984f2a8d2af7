"""Read events that a separate recorder wrote (`ucp-events/1`, one JSON object per line).

{"schema": "ucp-events/1", "agent_id": 7, "time_us": 1790000000000000, "event_id": 3, "data": "<base64>"}
"""

import base64
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.bounded_file import BoundedFile
from harness.archive.exports import AgentId, Base64
from harness.archive.traces import MAX_LINE_BYTES, MAX_LINE_WEIGHT
from harness.field.ingest._ingest import UnusedPart
from ucp.events import LoggableEvent
from ucp.plain_file import check_weight

SCHEMA: Literal["ucp-events/1"] = "ucp-events/1"
SUFFIX = ".events.jsonl"
MAX_EVENTS = 1_000_000


class EventLine(BaseModel):
    """One recorded event. `time_us` is in microseconds since the Unix epoch."""

    model_config = ConfigDict(extra="ignore")

    schema_: Annotated[Literal["ucp-events/1"], Field(alias="schema")] = SCHEMA
    agent_id: AgentId
    time_us: Annotated[int, Field(ge=0, lt=2**64, strict=True)]
    event_id: Annotated[int, Field(ge=1, le=254, strict=True)]
    data: Annotated[Base64, Field(max_length=100_000)]

    @classmethod
    def of(cls, agent_id: int, event: LoggableEvent) -> "EventLine":
        data = base64.b64encode(event.data).decode()
        return cls(agent_id=agent_id, time_us=event.timestamp_us, event_id=event.event_id, data=data)

    @property
    def event(self) -> LoggableEvent:
        return LoggableEvent(self.time_us, self.event_id, base64.b64decode(self.data))

    def to_line(self) -> str:
        return self.model_dump_json(by_alias=True) + "\n"


def read_logged(path: Path, left_out: list[UnusedPart]) -> list[tuple[int, LoggableEvent]]:
    """Return the events in a file, each with the ID of its agent. The list is empty if the file has another format.
    Raises OSError.
    """
    events: list[tuple[int, LoggableEvent]] = []
    damaged: list[int] = []
    with BoundedFile(path) as file:
        if SCHEMA.encode() not in file.peek(4096)[:4096]:
            return []
        number = 0
        while len(events) < MAX_EVENTS and (text := file.readline(MAX_LINE_BYTES)):
            number += 1
            try:
                check_weight(text, MAX_LINE_WEIGHT)
                line = EventLine.model_validate_json(text)
                events.append((line.agent_id, line.event))
            except ValueError:
                damaged.append(number)
        if file.problem:
            left_out.append(UnusedPart(path, file.problem))
    if damaged:
        more = f", and {len(damaged) - 1} more lines are" if len(damaged) > 1 else ""
        left_out.append(UnusedPart(path, f"it is damaged{more}", damaged[0]))
    return events
