"""Reading traces (`ucp-trace/1`): every handler run of one agent, with the blocks that it held after each.

A trace that ends in half a line is that of a killed agent, and is read up to there. Anything else that is not a trace
is told in `problem`, and what came before it still counts.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from ucp.trace import SCHEMA

SUFFIX = ".trace.jsonl"
MAX_LINE_CHARACTERS = 1024 * 1024
PLACES = ("chain", "deque", "stack")


class Sent(BaseModel):
    model_config = ConfigDict(extra="ignore")

    message: str
    seq: int
    block: str | None = None


class State(BaseModel):
    model_config = ConfigDict(extra="ignore")

    chain: int
    deque: int
    stack: int
    reconciling: bool
    idle: bool
    top: str


class TracedRun(BaseModel):
    """One handler run; see `ucp.trace.HandlerRun`. `line` counts from 1."""

    model_config = ConfigDict(extra="ignore")

    t: float
    handler: str
    algorithm: int
    trigger: dict[str, int | str]
    branch: str
    changes: list[tuple[str, str]]
    sent: list[Sent]
    state: State
    line: int = 0


class Header(BaseModel):
    model_config = ConfigDict(extra="ignore")

    agent_id: int
    roster: list[int]
    settings: dict[str, Any]
    clock: dict[str, Any]


@dataclass
class Trace:
    header: Header
    runs: list[TracedRun] = field(default_factory=list)
    problem: str | None = None

    def completed(self) -> list[str]:
        """Hashes of the blocks that the agent completed, in order."""
        return [block for run in self.runs for operation, block in run.changes if operation == "complete"]

    def chain_at(self, t: float) -> tuple[str, ...]:
        """The chain's block hashes, oldest first, as they were before mission second `t`."""
        chain: list[str] = []
        for run in self.runs:
            if run.t >= t:
                break
            for operation, block in run.changes:
                if operation == "chain+":
                    chain.append(block)
                elif operation == "chain-" and chain:
                    chain.pop()
        return tuple(chain)

    def steps(self) -> Iterator[tuple[TracedRun, "Held"]]:
        """Each run with what the agent held after it. The same `Held` is updated from step to step."""
        held = Held()
        for run in self.runs:
            held.replay(run)
            yield run, held


class Held:
    """Where an agent holds which block, how often, and which blocks it has completed."""

    def __init__(self) -> None:
        self.places: dict[str, Counter[str]] = {place: Counter() for place in PLACES}
        self.copies: Counter[str] = Counter()
        self.completed: dict[str, None] = {}
        self.not_in_chain: set[str] = set()
        """Completed blocks that are not in the chain."""
        self.impossible: str | None = None
        """What the last run's changes claim to remove although it was not there."""

    def replay(self, run: TracedRun) -> None:
        self.impossible = None
        for operation, block in run.changes:
            if operation == "complete":
                self.completed[block] = None
                self.not_in_chain.add(block)
                continue
            place, sign = operation[:-1], operation[-1:]
            if place not in self.places or sign not in ("+", "-"):
                self.impossible = f"unknown operation {operation!r}"
                continue
            if sign == "+":
                self.places[place][block] += 1
                self.copies[block] += 1
                if place == "chain":
                    self.not_in_chain.discard(block)
            elif self.places[place][block] < 1:
                self.impossible = f"{block[:12]} leaves the {place} without having been there"
            else:
                self.places[place][block] -= 1
                self.copies[block] -= 1
                if place == "chain" and block in self.completed and not self.places[place][block]:
                    self.not_in_chain.add(block)

    def size(self, place: str) -> int:
        return self.places[place].total()


def read_trace(path: Path) -> Trace | None:
    """The trace in `path`; None if there is none, or it does not even begin as one."""
    trace: Trace | None = None
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            number = 0
            while line := file.readline(MAX_LINE_CHARACTERS):
                number += 1
                if not line.endswith("\n"):
                    if trace is not None and len(line) == MAX_LINE_CHARACTERS:
                        trace.problem = f"line {number} is too long"
                    break
                try:
                    document = json.loads(line)
                    if isinstance(document, dict) and "schema" in document:
                        if document["schema"] != SCHEMA or trace is not None:
                            raise ValueError("a header in the wrong place")
                        trace = Trace(Header.model_validate(document))
                    elif trace is None:
                        return None
                    else:
                        run = TracedRun.model_validate(document)
                        run.line = number
                        trace.runs.append(run)
                except (ValueError, ValidationError, RecursionError):
                    if trace is not None:
                        trace.problem = f"line {number} is damaged"
                    break
    except OSError:
        return None
    return trace
