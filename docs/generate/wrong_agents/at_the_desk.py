"""Find agents with deliberate errors by `replay` of their traces: `python -m docs.generate.wrong_agents.at_the_desk
[QUIRK ...]`.

The agents run as processes. The program writes the table rows of the named quirks into
docs/appendix/wrong-agents-field.md. Without an argument, it writes the rows of all quirks. The text of the page is
written by hand.
"""

import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import shorten

from docs.generate.matrix_thesis import put_between_markers
from docs.generate.wrong_agents.quirky import PROBABILITY
from docs.generate.wrong_agents.trials_page import rows_of
from harness.archive.exports import agents_directory
from harness.archive.trace_files import SUFFIX
from harness.field.replay import RecordPlayer, open_record
from harness.field.replay.replay_names import ReplayNames
from harness.play.progress import SilentProgress
from harness.run.parallel import FailedTask, sweep
from harness.run.run import run
from harness.scenario import load_scenario
from ucp.agent import HANDLERS
from ucp.agent_files import write_atomically
from ucp.quirks import QUIRKS

PAGE = Path(__file__).parents[2] / "appendix/wrong-agents-field.md"
MISSION = Path(__file__).parent / "desk.yaml"
JOBS = 2
MOST_RUNS = 8
"""Maximum number of runs per quirk. The first run may lack the situation in which the error occurs."""
SHOWN = 160
HEADER = "| quirk | Algorithm | named first | correct | minutes | runs | difference |\n|---|--:|---|--:|--:|--:|---|\n"


@dataclass(frozen=True)
class Named:
    """The first difference in a record. `handler` is None if the difference cannot be assigned to a handler."""

    t: float
    handler: str | None
    difference: str


@dataclass(frozen=True)
class AtTheDesk:
    """The first difference in each record of the last run. Records without a difference are left out."""

    runs: int
    records: int
    named: tuple[Named, ...]


def at_the_desk(quirk: str) -> AtTheDesk:
    """Play runs with this error until a record differs from a correct agent, at most `MOST_RUNS` runs."""
    value = PROBABILITY if QUIRKS[quirk].chance else True
    scenario = load_scenario(MISSION).model_copy(update={"quirks": {quirk: value}})
    records, named = 0, list[Named]()
    for seed in range(1, MOST_RUNS + 1):
        with TemporaryDirectory(prefix="ucp-desk-") as name:
            brought_home = Path(name) / "home"
            brought_home.mkdir()
            run_directory = run(scenario, seed, Path(name) / "run", SilentProgress(), "process").directory
            for trace in agents_directory(run_directory).glob(f"*{SUFFIX}"):
                shutil.copy(trace, brought_home)
            traces = sorted(brought_home.iterdir())
            records, named = len(traces), list(_first_differences(traces))
        if named:
            break
    return AtTheDesk(seed, records, tuple(named))


def _first_differences(traces: Sequence[Path]) -> Iterator[Named]:
    for trace in traces:
        record = open_record(trace)
        first = RecordPlayer(record).to_end().first
        if first is not None:
            yield Named(first.t, first.handler, first.difference(ReplayNames(record).of))


def row(quirk: str, brought: AtTheDesk) -> str:
    """Return the table row of an error."""
    about = QUIRKS[quirk]
    first = min(brought.named, key=lambda named: named.t, default=None)
    cells = [f"`{quirk}`", ", ".join(map(str, about.algorithms))]
    if first is None:
        cells += ["no difference", "\u2013", "\u2013", str(brought.runs), "none"]
    else:
        rightly = sum(_is_of(named.handler, quirk) for named in brought.named)
        cells += [
            f"`{first.handler}`",
            f"{rightly} of {len(brought.named)}",
            f"{first.t / 60:.1f}",
            str(brought.runs),
            f"`{shorten(first.difference, SHOWN, placeholder=' …')}`".replace("|", "\\|"),
        ]
    return f"| {' | '.join(cells)} |\n"


def _is_of(handler: str | None, quirk: str) -> bool:
    return handler in HANDLERS and HANDLERS[handler].algorithm in QUIRKS[quirk].algorithms


def main(names: Sequence[str]) -> None:
    """Test the named errors, or all errors if none is named. Keep the other rows of the table."""
    with sweep(list(names or QUIRKS), at_the_desk, JOBS, what="quirks", in_order=False) as outcomes:
        for quirk, brought in outcomes:
            if isinstance(brought, FailedTask):
                sys.stderr.write(f"{quirk}: {brought.reason}\n")
                continue
            page = PAGE.read_text(encoding="utf-8")
            rows = rows_of(page) | {quirk: row(quirk, brought)}
            table = HEADER + "".join(rows[name] for name in QUIRKS if name in rows)
            write_atomically(PAGE, put_between_markers(page, table))


if __name__ == "__main__":
    main(sys.argv[1:])
