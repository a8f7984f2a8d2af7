"""Print the results of a matrix on the terminal: means with 95 % confidence intervals, laws of growth, and failures.

The file summary.md has the results of a matrix in Markdown, for a CI job or a message to a team.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from harness.present import text as words
from harness.present.text import escaped, row
from harness.report.agent_programs import asked_for, in_sentence
from harness.scenario.verdict_names import BAD_IN_WORDS, CHARACTERISTICS
from harness.sweep.matrix import _growth_table
from harness.sweep.matrix._cell import Cell
from harness.sweep.matrix._comparison import Change, ChangedRuns, Culprit
from harness.sweep.matrix._estimate import BY_NAME, METRICS, Estimate, Metric
from harness.sweep.matrix._matrix_file import Matrix, MatrixPoint
from harness.sweep.matrix.matrix_record import MatrixCoverage, MatrixRecord

NAMED = 5
"""Maximum number of seeds that the table lists for a cell. For further seeds, the table gives only their number.
matrix.json contains all seeds.
"""


def render(record: MatrixRecord) -> RenderableType:
    parts: list[RenderableType] = []
    for cells in series(record):
        if name := ", ".join(series_name(record.matrix, cells[0].point)):
            parts.append(Text(name, style="bold"))
        parts.append(_table(record, cells))
    notes = (Text(note, style="red") for note in troubles_of_all(record))
    lacking = (Text(note, style="yellow") for note in unsupported_of_all(record))
    better = (Text(note, style="green") for note in improvements(record))
    changed = (Text(note, style="yellow") for note in changed_runs(record))
    explained = Text(explanation(record) + unjudged(record), style="dim")
    growth = _growth_table.render(record)
    return Group(*parts, explained, *growth, Text(verdict(record)), *notes, *lacking, *better, *changed)


def _table(record: MatrixRecord, cells: Sequence[Cell]) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim")
    liveness = ["fin-\nished"] if any(cell.finished.n for cell in cells) else []
    for header in ("loss", "runs", *(metric.label for metric in METRICS), *liveness, "vio-\nlated"):
        table.add_column(header.replace(" ", "\n", 1), justify="right", vertical="bottom", no_wrap=True)
    for cell in cells:
        estimates = [(metric, cell.estimates[metric.name]) for metric in METRICS]
        means = (Text(say_mean(metric, estimate)) for metric, estimate in estimates)
        finished = [_finished(cell)] if liveness else []
        table.add_row(words.percent(cell.loss), str(cell.runs), *means, *finished, _violated(cell))
        if len(record.matrix.seed_list) > 1:
            table.add_row("", "", *(Text(say_interval(*pair), style="dim") for pair in estimates))
    return table


def series(record: MatrixRecord) -> list[list[Cell]]:
    """Divide the summaries into groups. Summaries in the same group differ only in their loss rates."""
    groups: dict[tuple[object, ...], list[Cell]] = {}
    for cell in record.cells:
        groups.setdefault((cell.backend, cell.duration_s, cell.agents), []).append(cell)
    return list(groups.values())


def axes(matrix: Matrix) -> dict[str, Callable[[MatrixPoint], str]]:
    """Return the values that differ within the matrix, with the loss rate first. Each value has a name, and a function
    that formats the value of a combination.
    """
    named: dict[str, Callable[[MatrixPoint], str]] = {"loss": lambda point: words.percent(point.loss)}
    if len(matrix.agents or ()) > 1:
        named["agents"] = lambda point: str(point.agents)
    if len(matrix.lengths) > 1:
        named["length"] = lambda point: words.duration(point.duration_s or 0.0)
    if len(matrix.backend) > 1:
        named["backend"] = lambda point: point.backend
    return named


def name_of(matrix: Matrix, point: MatrixPoint) -> str:
    """Return the name of a combination of values, such as "15 % loss" or "15 % loss, 10 agents, process"."""
    return ", ".join([f"{words.percent(point.loss)} loss", *series_name(matrix, point)])


def series_name(matrix: Matrix, point: MatrixPoint) -> list[str]:
    """Return the values, apart from the loss rate, that identify a combination."""
    named = axes(matrix)
    return [
        *([f"{point.agents} agents"] if "agents" in named else []),
        *([named[axis](point) for axis in ("length", "backend") if axis in named]),
    ]


def say_lengths(matrix: Matrix) -> str:
    """Format the mission lengths as text, such as "600 s, 1200 s"."""
    return ", ".join(map(words.duration, matrix.lengths))


def say(metric: Metric, estimate: Estimate) -> str:
    """Format a mean and its confidence interval as one line of text."""
    interval = say_interval(metric, estimate)
    return f"{say_mean(metric, estimate)} ({interval})" if interval else say_mean(metric, estimate)


def say_mean(metric: Metric, estimate: Estimate) -> str:
    if estimate.mean is None:
        return "\u2013"
    return _number(estimate.mean) if metric.unit == "number" else f"{_number(100 * estimate.mean)}\u00a0%"


def say_interval(metric: Metric, estimate: Estimate) -> str:
    """Format a confidence interval as text: both limits for a share, otherwise half its width."""
    if estimate.low is None or estimate.high is None:
        return ""
    if metric.unit == "share of runs":
        return f"{100 * estimate.low:.0f}\u2013{100 * estimate.high:.0f}\u00a0%"
    margin = (estimate.high - estimate.low) / 2
    return f"\u00b1{_margin(margin)}" if metric.unit == "number" else f"\u00b1{_margin(100 * margin)}\u00a0%"


def explanation(record: MatrixRecord) -> str:
    """Return a sentence that explains the numbers in the table."""
    counts = [cell.runs for cell in record.cells]
    if not counts:
        return "No run has ended."
    fewest, most = min(counts), max(counts)
    if most == 1:
        return "Each cell has one run, so there are no intervals."
    number = str(most) if fewest == most else f"{fewest} to {most}"
    same_seeds = " All cells have the same seeds." if fewest == len(record.matrix.seed_list) else ""
    return f"Means of {number} runs per cell, with 95 % intervals.{same_seeds}"


def unjudged(record: MatrixRecord) -> str:
    """Return a sentence about the characteristics that no run could judge, or an empty text."""
    judged = {
        number for cell in record.cells for number, counts in cell.verdicts.items() if set(counts) - {"not applicable"}
    }
    never = [number for number in CHARACTERISTICS if number not in judged]
    if not never or not record.cells:
        return ""
    return f" Not applicable in any run: characteristic{'s' if len(never) > 1 else ''} {', '.join(never)}."


def violated(cell: Cell) -> int:
    """Return the number of runs that have a bad verdict."""
    return len({seed for seeds in cell.violated.values() for seed in seeds})


def troubles(record: MatrixRecord, cell: Cell) -> Iterable[str]:
    """Yield a sentence for each failure, bad verdict, unfinished run and worsened numeric result of a cell."""
    by_words = {BAD_IN_WORDS[key]: seeds for key, seeds in cell.violated.items()}
    for trouble, seeds in {**by_words, "more time needed": cell.unfinished}.items():
        if seeds:
            which = ", ".join(map(str, seeds[:NAMED])) + (", \u2026" if len(seeds) > NAMED else "")
            plural = "s" if len(seeds) > 1 else ""
            first = _first_deviations(cell) if trouble == BAD_IN_WORDS["steps"] else ""
            yield f"{trouble} in {len(seeds)} of {cell.runs} runs, seed{plural} {which}{first}"
    failed = [run for run in record.failed if run.point == cell.point]
    for run in failed[:NAMED]:
        yield f"seed {run.seed} failed: {run.reason}"
    if len(failed) > NAMED:
        yield f"{len(failed) - NAMED} more runs failed"
    for change in record.against.regressions if record.against else ():
        if change.point == cell.point:
            yield _say_change(change)
    for culprit in record.against.culprits if record.against else ():
        if culprit.point == cell.point:
            yield from _say_culprit(culprit)


def _first_deviations(cell: Cell) -> str:
    """Return the places of the first deviations from the algorithms, with the number of runs for each place."""
    places = [f"{place} ({count})" for place, count in cell.deviations.items()]
    return f"; first in {', '.join(places)}" if places else ""


def unsupported(record: MatrixRecord, cell: Cell) -> Iterable[str]:
    """Return the features that these runs need and that agents lack, without duplicates."""
    return dict.fromkeys(run.reason for run in record.unsupported if run.point == cell.point)


def unsupported_of_all(record: MatrixRecord) -> Iterable[str]:
    for cell in record.cells:
        for sentence in unsupported(record, cell):
            yield f"{name_of(record.matrix, cell.point)}: {sentence}"


def troubles_of_all(record: MatrixRecord) -> Iterable[str]:
    for cell in record.cells:
        for sentence in troubles(record, cell):
            yield f"{name_of(record.matrix, cell.point)}: {sentence}"


def improvements(record: MatrixRecord) -> Iterable[str]:
    for change in record.against.changes if record.against else ():
        if not change.worse:
            yield f"{name_of(record.matrix, change.point)}: {_say_change(change)}"


def changed_runs(record: MatrixRecord) -> Iterable[str]:
    """Yield a sentence for each group of runs that differ from the earlier night, and for each group that cannot be
    compared.
    """
    if record.against is None:
        return
    for changed in record.against.changed_runs:
        seeds = ", ".join(map(str, changed.seeds[:NAMED])) + (", \u2026" if len(changed.seeds) > NAMED else "")
        plural = "s" if len(changed.seeds) > 1 else ""
        yield (
            f"{name_of(record.matrix, changed.point)}: {len(changed.seeds)} of {changed.pairs} runs differ from the "
            f"baseline, seed{plural} {seeds}{_first_changes(changed)}"
        )
    yield from record.against.not_compared


def _say_culprit(culprit: Culprit) -> Iterable[str]:
    metric = BY_NAME[culprit.metric]
    for commit in culprit.commits:
        after, before = ("unknown" if each is None else f"{each:.4g}" for each in (commit.after, commit.before))
        became = f"{metric.label} of seed {culprit.seed} becomes {after}, was {before}"
        yield f"{became}, at {commit.hash[:12]}, {commit.date}, {commit.author}: {commit.subject}"
    if culprit.problem:
        yield f"no further commit was found for {metric.label} of seed {culprit.seed}: {culprit.problem}"


def _first_changes(changed: ChangedRuns) -> str:
    """Return a phrase about the first difference between each run and the same run of the earlier night. The phrase
    contains the handlers that ran differently, and the place of the earliest difference. Return an empty text if no
    handler is known.
    """
    known = [each for each in changed.first if each.handler is not None]
    if not known:
        return ""
    counts = Counter(each.handler for each in known).most_common()
    handlers = ", ".join(f"{handler} ({count})" for handler, count in counts[:NAMED])
    first = min(known, key=lambda each: each.at_s or 0.0)
    where = f"of seed {first.seed} at {first.at_s:.1f} s, agent {first.agent_id}"
    return f"; they differ first in {handlers}, the earliest {where}"


def _say_change(change: Change) -> str:
    metric = BY_NAME[change.metric]
    became = "worse" if change.worse else "better"
    if change.difference is not None:
        means = f"{say_mean(metric, change.now)}, was {say_mean(metric, change.before)}"
        return f"{metric.label} {became}: {means}; {_say_difference(change)}"
    return f"{metric.label} {became}: {say(metric, change.now)}, was {say(metric, change.before)}"


def _say_difference(change: Change) -> str:
    """Return a text with the mean difference between runs with the same seed, and its confidence interval. The text
    shows percentages if possible.
    """
    metric, difference, before = BY_NAME[change.metric], change.difference, change.before.mean
    assert difference is not None, "the change is one of pairs"
    factor, unit = (1.0, "") if metric.unit == "number" else (100.0, "\u00a0points")
    if metric.unit == "number" and before:
        factor, unit = 100 / before, "\u00a0%"
    mean, low, high = (factor * (value or 0.0) for value in (difference.mean, difference.low, difference.high))
    return f"{mean:+.3g}{unit} in {difference.n} pairs ({low:+.3g} to {high:+.3g})"


def say_finished(cell: Cell) -> str:
    """Format the share of runs in which the swarm became idle as text."""
    share = cell.finished.mean
    return "\u2013" if share is None else f"{round(100 * share)}\u00a0%"


def _finished(cell: Cell) -> Text:
    return Text(say_finished(cell), style="green" if cell.finished.mean in (None, 1.0) else "bold red")


def _violated(cell: Cell) -> Text:
    runs = violated(cell)
    if cell.unsupported == cell.runs:
        return Text("\u2013")
    if cell.failed:
        return Text(f"{runs} + {cell.failed}", style="bold red")
    return Text(str(runs), style="bold red" if runs else "green")


def _number(number: float) -> str:
    """Format a number with about three significant digits."""
    digits = 2 if abs(number) < 10 else 1 if abs(number) < 100 else 0
    text = f"{number:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _margin(number: float) -> str:
    return f"{number:.2g}" if number < 99.5 else f"{number:.0f}"


def to_markdown(record: MatrixRecord) -> str:
    lines = [f"## {escaped(record.matrix.name)}", "", f"**{verdict(record)}**", "", *_markdown_table(record), ""]
    lines += [explanation(record) + unjudged(record), ""]
    compared = [*improvements(record), *changed_runs(record)]
    if findings := [*troubles_of_all(record), *unsupported_of_all(record), *compared]:
        lines += [*(f"- {escaped(sentence)}" for sentence in findings), ""]
    if record.tried is not None:
        lines += [*map(escaped, describe_coverage(record.tried)), ""]
    if ran := in_sentence(asked_for(record.matrix.scenario_at(record.matrix.points[-1]))):
        lines += [escaped(ran), ""]
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    lines += [f"<sub>Begun {words.started(record.started_at)}; {versions}</sub>"]
    return "\n".join(lines) + "\n"


def describe_coverage(tried: MatrixCoverage) -> Iterator[str]:
    """Yield sentences about the share of the protocol that the runs reached."""
    every, branches = tried.all_cells, tried.all_cells["branches"]
    yield (
        f"Coverage of {words.value(tried.runs)} runs: {words.value(every['local_states'])} local states, "
        f"{words.value(every['pairs'])} pairs of a local state and an input, "
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
    parts = [f"{words.value(runs)} runs"]
    if record.outcome == "interrupted":
        parts[0] += f" of {words.value(record.runs_asked)}, interrupted"
    elif runs < record.runs_asked:
        parts[0] += f" of {words.value(record.runs_asked)} in the given time"
    bad = sum(map(violated, record.cells))
    parts.append(f"{bad} with violations" if bad else "no violations")
    if record.failed:
        parts.append(f"{len(record.failed)} failed")
    if record.unsupported:
        parts.append(f"{len(record.unsupported)} not supported")
    if record.against and record.against.cells and record.against.started_at is not None:
        worse = len(record.against.regressions)
        which = f"{worse} figures are worse" if worse > 1 else f"{worse or 'no'} figure is worse"
        parts.append(f"{which} than on {words.started(record.against.started_at)}")
    if record.against and record.against.not_compared:
        parts.append("not all cells are compared" if record.against.cells else "not compared with the baseline")
    return "; ".join(parts)


def _markdown_table(record: MatrixRecord) -> Iterator[str]:
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
