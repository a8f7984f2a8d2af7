"""What scale.json says, schema `ucp-scale/1`. Keys are added, never removed or renamed.

All but `started_at`, `wall_s`, `machine_growths` and the cells' `machine` is virtual: equal on every machine.
"""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.errors import INTERRUPTED, VIOLATED
from harness.sweep.scale._cell import Cell, Growth
from harness.sweep.scale.model import Scale

MACHINE = {
    "started_at": True,
    "wall_s": True,
    "machine_growths": True,
    "cells": {"__all__": {"machine": True}},
}
"""The keys that are this machine's, as pydantic excludes them."""


class Blemish(BaseModel):
    """A run without a result and why, or with characteristics violated."""

    loss: float
    minutes: float
    agents: int
    seed: int
    failed: str | None = None
    violated: list[str] = []


class ScaleRecord(BaseModel):
    """One sweep. A cell for each size of which a run has ended."""

    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["ucp-scale/1"] = Field(default="ucp-scale/1", alias="schema")
    scale: Scale
    backend: Literal["sim"]
    versions: dict[str, str]
    started_at: str
    wall_s: float
    outcome: Literal["completed", "interrupted"]
    cells: list[Cell]
    growths: list[Growth]
    machine_growths: list[Growth]
    blemishes: list[Blemish] = []

    @property
    def runs(self) -> int:
        return sum(cell.runs for cell in self.cells)

    @property
    def runs_asked(self) -> int:
        return len(self.scale.sizes) * self.scale.seeds

    @property
    def exit_status(self) -> int:
        """As documented for the command line; a run that failed counts like an agent that did."""
        if self.outcome == "interrupted":
            return INTERRUPTED
        return VIOLATED if self.blemishes else 0

    def to_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True)

    def repeatable(self) -> dict[str, Any]:
        """What every machine finds for this request and this version."""
        return self.model_dump(mode="json", by_alias=True, exclude=MACHINE)  # type: ignore[arg-type]
