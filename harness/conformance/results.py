"""Store the results of a conformance test: counts for each Algorithm, and the expected and received messages of
failures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from harness.conformance._observation import RecordedDatagram
from harness.errors import CANNOT_HERE, INTERRUPTED, VIOLATED
from ucp.agent import HANDLERS
from ucp.trace import in_base64

SCHEMA = "ucp-conformance/1"

CaseVerdict = Literal["passed", "failed", "not applicable", "not tried"]
TITLES = {handler.algorithm: handler.title for handler in HANDLERS.values()}
FURTHER_CHECKS = 0
"""The value that replaces an Algorithm number in cases about the program, its datagrams and its files."""


@dataclass(frozen=True)
class CaseResult:
    """The result of one handwritten test case, or of a generated test that failed."""

    name: str
    algorithm: int
    verdict: CaseVerdict
    handler: str = ""
    branch: str = ""
    reason: str = ""
    """A sentence with the cause of the verdict."""
    settings: str = ""
    inputs: tuple[str, ...] = ()
    """All inputs of the agent. The agent answered the last input wrongly."""
    expected: tuple[str, ...] = ()
    received: tuple[str, ...] = ()
    wrong: tuple[str, ...] = ()
    exchanges: tuple[RecordedDatagram, ...] = ()
    directory: str | None = None
    section: str = ""

    def to_json(self) -> dict[str, Any]:
        words = {
            "case": self.name,
            "algorithm": self.algorithm or None,
            "handler": self.handler or None,
            "branch": self.branch or None,
            "verdict": self.verdict,
            "reason": self.reason,
            "section": self.section or None,
        }
        if self.verdict != "failed":
            return words
        return {
            **words,
            "settings": self.settings,
            "inputs": list(self.inputs),
            "expected": list(self.expected),
            "came": list(self.received),
            "wrong": list(self.wrong),
            "exchanges": [
                {
                    "t": exchange.t,
                    "from": "agent" if exchange.sent else "peers",
                    "says": exchange.text,
                    "datagram": in_base64(exchange.data),
                }
                for exchange in self.exchanges
            ],
            "directory": self.directory,
        }


@dataclass
class AlgorithmCounts:
    """The number of test cases of one Algorithm, by verdict."""

    algorithm: int
    passed: int = 0
    failed: int = 0
    not_applicable: int = 0
    not_tried: int = 0

    @property
    def title(self) -> str:
        return TITLES.get(self.algorithm, "The program, its datagrams and its files")

    @property
    def tried(self) -> int:
        return self.passed + self.failed


@dataclass
class ConformanceResults:
    """The results of a conformance test of one agent."""

    command: Sequence[str]
    wall_s: float
    started_at: str
    cases: list[CaseResult] = field(default_factory=list)
    counted: dict[int, AlgorithmCounts] = field(default_factory=dict)
    """Algorithm -> the numbers of its vectors by verdict. `cases` contains the vectors that failed."""
    notes: list[str] = field(default_factory=list)
    interrupted: bool = False

    def rows(self) -> list[AlgorithmCounts]:
        rows = {number: AlgorithmCounts(number) for number in (*sorted(TITLES), FURTHER_CHECKS)}
        for number, counted in self.counted.items():
            rows[number] = AlgorithmCounts(
                number, counted.passed, counted.failed, counted.not_applicable, counted.not_tried
            )
        for case in self.cases:
            row, key = rows[case.algorithm], case.verdict.replace(" ", "_")
            setattr(row, key, getattr(row, key) + 1)
        return [row for row in rows.values() if row.tried or row.not_applicable or row.not_tried]

    @property
    def failures(self) -> list[CaseResult]:
        return [case for case in self.cases if case.verdict == "failed"]

    @property
    def not_tried(self) -> int:
        return sum(row.not_tried for row in self.rows())

    @property
    def exit_status(self) -> int:
        """The exit status of the command. A test case that was not run does not count as passed."""
        if self.interrupted:
            return INTERRUPTED
        if self.failures:
            return VIOLATED
        return CANNOT_HERE if self.not_tried else 0

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "command": list(self.command),
            "started_at": self.started_at,
            "wall_s": round(self.wall_s, 1),
            "interrupted": self.interrupted,
            "algorithms": [
                {
                    "algorithm": row.algorithm or None,
                    "title": row.title,
                    "passed": row.passed,
                    "failed": row.failed,
                    "not_applicable": row.not_applicable,
                    "not_tried": row.not_tried,
                }
                for row in self.rows()
            ],
            "cases": [case.to_json() for case in self.cases],
            "notes": self.notes,
        }
