"""Write the test results of several agents as a table of agents and Algorithms, in a single HTML file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.conformance.results import FURTHER_CHECKS, TITLES, AlgorithmCounts, ConformanceResults
from harness.conformance.results_table import headline
from harness.errors import HarnessError, ScenarioError
from harness.report import html
from harness.scenario.load import parse_yaml
from ucp.plain_file import read_text

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE = """
td.holds { color: var(--good, #1a7f37); } td.violated { color: var(--bad, #cf222e); font-weight: 600; }
td { font-variant-numeric: tabular-nums; text-align: center; } th[scope=row] { text-align: left; }
"""
MAX_BYTES = 256 * 1024
MAX_AGENTS = 50
FAILURES_SHOWN = 20


class AgentsFileError(HarnessError):
    """An error: the file that lists the agents cannot be used."""


@dataclass(frozen=True)
class TableCell:
    """The conformance results of one agent for one Algorithm."""

    text: str
    kind: str
    """CSS class of the cell."""


def read_agents(path: Path) -> dict[str, list[str]]:
    """Return the command of each agent by name, from a YAML file. Raises AgentsFileError."""
    form = "`name: [program, argument, ...]` for each agent"
    try:
        document: Any = parse_yaml(read_text(path, MAX_BYTES))
    except OSError as error:
        raise AgentsFileError(f"{path} cannot be read: {error.strerror}") from None
    except (ScenarioError, ValueError):
        raise AgentsFileError(f"{path} is not YAML: it must be {form}") from None
    right = isinstance(document, dict) and all(
        isinstance(name, str)
        and isinstance(command, list)
        and command
        and all(isinstance(word, str) and "\0" not in word for word in command)
        for name, command in document.items()
    )
    if not right or not 0 < len(document) <= MAX_AGENTS:
        raise AgentsFileError(f"{path} must be {form}, with 1 to {MAX_AGENTS} agents")
    return {name: list(command) for name, command in document.items()}


def to_html(results: Mapping[str, ConformanceResults | str]) -> str:
    """Return the conformance results as an HTML page. For an agent that could not be tested, the page contains a
    sentence.
    """
    tested = {name: result for name, result in results.items() if isinstance(result, ConformanceResults)}
    rows = {name: {row.algorithm: row for row in result.rows()} for name, result in tested.items()}
    numbers = [number for number in (*sorted(TITLES), FURTHER_CHECKS) if any(number in each for each in rows.values())]
    failed = sum(len(result.failures) for result in tested.values())
    return html.render(
        _TEMPLATE,
        styles=[html.PAGE_STYLE + _STYLE],
        headline=(f"{failed} failed", "violated") if failed else (f"{len(tested)} agents, all passed", "holds"),
        names=list(results),
        table=[
            (
                AlgorithmCounts(number).title,
                [_table_cell(rows.get(name, {}).get(number), name in tested) for name in results],
            )
            for number in numbers
        ],
        notes=[(name, _notes(result)) for name, result in results.items()],
    )


def _table_cell(row: AlgorithmCounts | None, tested: bool) -> TableCell:
    if row is None:
        return TableCell("\u2013" if tested else "not tested", "")
    if row.failed:
        return TableCell(f"{row.failed} failed, {row.passed} passed", "violated")
    if row.passed:
        left = f", {row.not_tried} not tried" if row.not_tried else ""
        return TableCell(f"{row.passed} passed{left}", "holds")
    return TableCell("not applicable" if row.not_applicable else "not tried", "")


def _notes(result: ConformanceResults | str) -> Sequence[str]:
    if isinstance(result, str):
        return [result]
    failures = [headline(case) for case in result.failures[:FAILURES_SHOWN]]
    if len(result.failures) > FAILURES_SHOWN:
        failures.append(f"and {len(result.failures) - FAILURES_SHOWN} more")
    return [" ".join(result.command), *result.notes, *failures]
