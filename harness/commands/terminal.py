"""Print results as text or JSON on standard output, and problems on standard error. All commands use this module."""

import io
import json
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn, Self

import typer
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from harness import checker
from harness.archive.run_record import RogueInjection, RunRecord, Survival
from harness.checker import injections, survival
from harness.report import agent_programs
from harness.scenario.expect import AS_EXPECTED
from harness.scenario.verdict_names import CHARACTERISTICS, Kind

if TYPE_CHECKING:
    from harness.sweep.matrix.matrix_record import MatrixRecord

STYLES: dict[Kind, str] = {"good": "green", "bad": "bold red", "unknown": "yellow"}
MARKS: dict[Kind, str] = {"good": "✔", "bad": "✘", "unknown": "-"}
EVIDENCE_SHOWN = 5
LINE_EVERY_S = 10.0
UNLIMITED = 1_000_000
"""Maximum width of the output in a pipe or file, in characters."""


def output(*, stderr: bool = False, highlight: bool = True) -> Console:
    """Return a console for output. Outside a terminal, lines are not wrapped unless COLUMNS sets a width."""
    console = Console(stderr=stderr, highlight=highlight)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    return console


def show_result(console: Console, result: checker.Result, record: RunRecord) -> None:
    """Print the verdicts and the numeric results of a run. `record` contains the expectations of the scenario."""
    expect, table = record.expect, Table.grid(padding=(0, 2))
    for key, judgement in result.judgements.items():
        expected = expect.remark(key, judgement.verdict) == AS_EXPECTED
        words = f"{MARKS[judgement.kind]} {expect.in_words(key, judgement.verdict)}"
        verdict = Text(words, style=STYLES["unknown" if expected else judgement.kind])
        number = key if key in CHARACTERISTICS else ""
        table.add_row(number, judgement.name, verdict, Text(judgement.reason))
        for finding in judgement.evidence[:EVIDENCE_SHOWN]:
            table.add_row("", "", "", Text(f"agent {finding.agent_id}: {finding.detail}", style="red"))
        if len(judgement.evidence) > EVIDENCE_SHOWN:
            table.add_row(
                "", "", "", Text(f"and {len(judgement.evidence) - EVIDENCE_SHOWN} more in run.json or --json")
            )
    console.print(table)
    known = {name: value for name, value in result.figures.items() if value is not None}
    words = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in known.items())
    console.print(words, highlight=False, style="dim")
    for _, unmet in record.unmet_expectations(result.chains, result.top_chain_hashes):
        for sentence in unmet:
            complain(sentence)


def show_programs(console: Console, record: RunRecord) -> None:
    if ran := agent_programs.programs(record):
        console.print(Text(agent_programs.in_sentence(ran), style="dim"), soft_wrap=True)


def show_survival(console: Console, survived: Survival) -> None:
    for sentence in survival.in_words(survived):
        console.print(sentence, highlight=False, soft_wrap=True)


def show_rogue(console: Console, injected: list[RogueInjection]) -> None:
    for injection in injected:
        console.print(injections.in_words(injection), highlight=False, soft_wrap=True)


def end_sweep(record: "MatrixRecord", table: RenderableType | None, picture: Path) -> NoReturn:
    """Print the result of a matrix as a table and end the command. Without a table, print the result as JSON."""
    if table is None:
        print_json(record.to_json())
    else:
        console = output()
        console.print(table)
        console.print(f"{record.wall_s:.0f} s; {picture}", highlight=False, soft_wrap=True)
    if record.outcome == "interrupted":
        ended = f"results of {record.runs} of {record.runs_asked} runs are in {picture.parent}"
        complain(f"interrupted; {ended}")
    raise typer.Exit(record.exit_status)


def print_lines(texts: Iterable[str]) -> None:
    """Print lines as they are, without markup. A character that the terminal cannot show becomes a question mark."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    for text in texts:
        sys.stdout.write(text + "\n")


def print_json(document: Any) -> None:
    sys.stdout.write(json.dumps(document, indent=1) + "\n")


def complain(sentence: str) -> None:
    Console(stderr=True).print(Text(f"ucp-harness: {sentence}", style="red"), soft_wrap=True)


class StatusLine:
    """A progress display on standard error. A terminal shows one line that changes. Other outputs get a line every 10
    s.
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._status = self._console.status("begins")
        self._last_s = time.monotonic()

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._status.stop()

    def show(self, words: str) -> None:
        if self._console.is_terminal:
            self._status.update(words)
        elif time.monotonic() - self._last_s > LINE_EVERY_S:
            self._last_s = time.monotonic()
            self._console.print(words, highlight=False)
