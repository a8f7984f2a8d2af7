"""Print results on the terminal, write them as JUnit XML, and show the progress of a test."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from harness.conformance.results import AlgorithmCounts, CaseResult, ConformanceResults
from harness.errors import CANNOT_HERE
from harness.present.junit import JunitCase as JunitCase
from harness.present.junit import to_xml

EXCHANGES_SHOWN = 14
FAILURES_SHOWN = 12
WRONG_SHOWN = 6
NOT_TRIED = (
    "Some vectors were not run within the time limit. Try again on a less busy machine, with one Algorithm (--only), "
    "or in virtual time (--virtual)."
)


def render(results: ConformanceResults) -> RenderableType:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("Algorithm")
    for head in ("passed", "failed", "not applicable", "not tried"):
        table.add_column(head, justify="right")
    for row in results.rows():
        table.add_row(row.title, *_counts(row))
    parts: list[RenderableType] = [table]
    for case in results.failures[:FAILURES_SHOWN]:
        parts += ["", *_failure(case)]
    if len(results.failures) > FAILURES_SHOWN:
        parts.append(Text(f"and {len(results.failures) - FAILURES_SHOWN} more, in --json", style="red"))
    for case in results.cases:
        if case.verdict == "not applicable":
            parts.append(Text(f"not applicable: {case.name}: {case.reason}", style="yellow"))
    parts += [Text(note, style="yellow") for note in results.notes]
    if results.exit_status == CANNOT_HERE:
        parts.append(Text(NOT_TRIED, style="yellow"))
    colour = "red" if results.failures else "yellow" if results.exit_status else "green"
    parts.append(Text(summary(results), style=f"bold {colour}"))
    return Group(*parts)


def summary(results: ConformanceResults) -> str:
    rows = results.rows()
    passed, failed = sum(row.passed for row in rows), sum(row.failed for row in rows)
    words = f"{passed} passed, {failed} failed"
    if not_applicable := sum(row.not_applicable for row in rows):
        words += f", {not_applicable} not applicable"
    if results.not_tried:
        words += f", {results.not_tried} not tried"
    return f"{words}; {results.wall_s:.0f} s"


def _counts(row: AlgorithmCounts) -> list[Text]:
    styled = ((row.passed, "green"), (row.failed, "bold red"), (row.not_applicable, "yellow"), (row.not_tried, ""))
    return [Text(str(count), style=style) if count else Text("\u2013", style="dim") for count, style in styled]


def headline(case: CaseResult) -> str:
    """Return one line about a test case: Algorithm, handler, branch, and name."""
    where = f"Algorithm {case.algorithm} {case.handler}" if case.algorithm else case.handler or "the program"
    branch = f", branch {case.branch!r}" if case.branch else ""
    settings = f" (settings: {case.settings})" if case.settings not in ("", "default") else ""
    section = f" [{case.section}]" if case.section else ""
    return f"{where}{branch}: {case.name}{settings}{section}"


def lines_of(case: CaseResult) -> Iterator[str]:
    """Yield the lines about a failure: inputs, expected and received messages, deviations, and the last datagrams."""
    yield headline(case)
    if case.inputs:
        yield f"  after {'; '.join(case.inputs[:-1])}" if case.inputs[:-1] else "  from its start"
        yield f"  given {case.inputs[-1]}"
    if case.inputs or case.expected or case.received:
        yield f"  expected {'; '.join(case.expected) or 'nothing'}"
        yield f"  came     {'; '.join(case.received) or 'nothing'}"
    for sentence in case.wrong[:WRONG_SHOWN]:
        yield f"  {sentence}"
    for exchange in case.exchanges[-EXCHANGES_SHOWN:]:
        yield f"  {exchange.t:10.3f} s  {'agent ' if exchange.sent else 'peers '} {exchange.text}"
    if case.directory:
        yield f"  look into {case.directory}"


def _failure(case: CaseResult) -> list[Text]:
    first, *others = lines_of(case)
    return [Text(f"✘ {first}", style="bold red"), *(Text(line) for line in others)]


def to_junit(results: ConformanceResults) -> str:
    """Return JUnit XML with a test case for each failure, for each handwritten test, and for all generated tests of
    each Algorithm.
    """
    return to_xml("conformance", "conformance", results.started_at, results.wall_s, _junit_cases(results))


def _junit_cases(results: ConformanceResults) -> Iterator[JunitCase]:
    for number, row in sorted(results.counted.items()):
        algorithm = f"Algorithm {row.title}: " if number else ""
        if row.passed:
            yield JunitCase(f"{algorithm}{row.passed} vectors")
        for count, why in ((row.not_applicable, "not applicable"), (row.not_tried, "not tried")):
            if count:
                yield JunitCase(f"{algorithm}{count} vectors {why}", skipped=why)
    for case in results.cases:
        if case.verdict == "failed":
            yield JunitCase(headline(case), list(lines_of(case)))
        else:
            yield JunitCase(headline(case), skipped=None if case.verdict == "passed" else case.reason or case.verdict)


REDRAW_EVERY_S, LINE_EVERY_S = 0.2, 10.0


@contextmanager
def progress() -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows progress. The arguments of the function are the number of passed tests and the number
    of all tests.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal)
    task = bar.add_task("vectors", total=None)
    last = time.monotonic()

    def show_progress(count: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last < (REDRAW_EVERY_S if console.is_terminal else LINE_EVERY_S):
            return
        last = time.monotonic()
        bar.update(task, completed=count, total=total, refresh=True)
        if not console.is_terminal:
            console.print(f"{count} of {total} vectors", highlight=False, soft_wrap=True)

    with bar:
        yield show_progress
