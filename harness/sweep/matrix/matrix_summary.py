"""Write summary.md, the results of a matrix in Markdown, for a CI job or a message to a team."""

from collections.abc import Iterator

from harness.present import text
from harness.present.text import escaped, row
from harness.report.agent_programs import asked_for, in_sentence
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._estimate import METRICS
from harness.sweep.matrix.matrix_record import MatrixCoverage, MatrixRecord
from harness.sweep.matrix.matrix_table import (
    axes,
    changed_runs,
    explanation,
    improvements,
    say_finished,
    say_interval,
    say_mean,
    troubles_of_all,
    unjudged,
    unsupported_of_all,
    violated,
)


def to_markdown(record: MatrixRecord) -> str:
    lines = [f"## {escaped(record.matrix.name)}", "", f"**{verdict(record)}**", "", *_table(record), ""]
    lines += [explanation(record) + unjudged(record), ""]
    compared = [*improvements(record), *changed_runs(record)]
    if findings := [*troubles_of_all(record), *unsupported_of_all(record), *compared]:
        lines += [*(f"- {escaped(sentence)}" for sentence in findings), ""]
    if record.tried is not None:
        lines += [*map(escaped, describe_coverage(record.tried)), ""]
    if ran := in_sentence(asked_for(record.matrix.scenario_at(record.matrix.points[-1]))):
        lines += [escaped(ran), ""]
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    lines += [f"<sub>Begun {text.started(record.started_at)}; {versions}</sub>"]
    return "\n".join(lines) + "\n"


def describe_coverage(tried: MatrixCoverage) -> Iterator[str]:
    """Yield sentences about the share of the protocol that the runs reached."""
    every, branches = tried.all_cells, tried.all_cells["branches"]
    yield (
        f"Coverage of {text.value(tried.runs)} runs: {text.value(every['local_states'])} local states, "
        f"{text.value(every['pairs'])} pairs of a local state and an input, "
        f"{branches['taken']} of {branches['exist']} branches of the handlers."
    )
    within = every["within"]
    states, pairs = within["local_states"], within["pairs"]
    yield (
        f"Within the bounds of {within['agents']} agents, {within['blocks']} blocks and a {within['network']} network: "
        f"{states['reached']} of {states['exist']} local states, {pairs['reached']} of {pairs['exist']} pairs."
    )
    if every["untold"]:
        yield f"The coverage is incomplete: {every['untold']}."


def verdict(record: MatrixRecord) -> str:
    """Return the headline. It contains the numbers of runs, of violations, of failures, and of numeric results that
    became worse.
    """
    runs = sum(cell.runs for cell in record.cells)
    parts = [f"{text.value(runs)} runs"]
    if record.outcome == "interrupted":
        parts[0] += f" of {text.value(record.runs_asked)}, interrupted"
    elif runs < record.runs_asked:
        parts[0] += f" of {text.value(record.runs_asked)} in the given time"
    bad = sum(map(violated, record.cells))
    parts.append(f"{bad} with violations" if bad else "no violations")
    if record.failed:
        parts.append(f"{len(record.failed)} failed")
    if record.unsupported:
        parts.append(f"{len(record.unsupported)} not supported")
    if record.against and record.against.cells and record.against.started_at is not None:
        worse = len(record.against.regressions)
        which = f"{worse} figures are worse" if worse > 1 else f"{worse or 'no'} figure is worse"
        parts.append(f"{which} than on {text.started(record.against.started_at)}")
    if record.against and record.against.not_compared:
        parts.append("not all cells are compared" if record.against.cells else "not compared with the baseline")
    return "; ".join(parts)


def _table(record: MatrixRecord) -> Iterator[str]:
    named = axes(record.matrix)
    headers = [*named, "runs", *(metric.label for metric in METRICS), "finished", "violated", "failed"]
    yield row(headers)
    yield row(["--:"] * len(headers))
    for cell in record.cells:
        yield row([*(say(cell.point) for say in named.values()), str(cell.runs), *_figures(cell), *_bad(cell)])


def _figures(cell: Cell) -> Iterator[str]:
    for metric in METRICS:
        estimate = cell.estimates[metric.name]
        interval = say_interval(metric, estimate)
        yield say_mean(metric, estimate) + (f"<br><sub>{interval}</sub>" if interval else "")


def _bad(cell: Cell) -> Iterator[str]:
    yield say_finished(cell)
    for number in (violated(cell), cell.failed):
        yield f"**{number}**" if number else "0"
