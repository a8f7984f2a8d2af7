"""`import.json`: what an import used, and what it did not, and why."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.field.ingest.ingest import Remark
from harness.scenario.strict_model import VehicleKey

FILE = "import.json"


class ImportedAgent(BaseModel):
    """What there is of one agent: files relative to the flight's directory, and what they were made from.

    `handler_runs`, `lives`, `gaps` and `clock_jumps` are of its trace.
    """

    trace: str | None = None
    handler_runs: int = 0
    lives: int = 0
    gaps: int = 0
    clock_jumps: int = 0
    trace_from: list[str] = []
    export: str | None = None
    capture: str | None = None
    events: str | None = None


class ImportedFlight(BaseModel):
    """`directory` is relative to the import's; `initial_data` is in base64."""

    directory: str
    initial_data: str | None
    epoch_us: int | None
    roster: list[int]
    agents: dict[VehicleKey, ImportedAgent]
    more_captures: list[str] = []


class ImportRemark(BaseModel):
    """Of a file of the sources, or of the line, row or message of it that `counts` says: `why` ends a sentence."""

    path: str
    line: int | None
    counts: str
    why: str

    @property
    def sentence(self) -> str:
        return Remark(Path(self.path), self.why, self.line, self.counts).sentence


class ImportRecord(BaseModel):
    """The flights, the one with the most in it first; what was left out; and what must be known of the rest."""

    model_config = ConfigDict(extra="ignore")

    schema_: Annotated[Literal["ucp-import/1"], Field(alias="schema")] = "ucp-import/1"
    sources: list[str]
    flights: list[ImportedFlight]
    left_out: list[ImportRemark]
    remarks: list[ImportRemark]

    def to_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True)
