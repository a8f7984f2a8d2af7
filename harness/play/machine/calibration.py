"""What this machine's network really does to packets, for `ucp-harness doctor --measure`: measuring, and a table."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import get_args

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from harness.errors import MachineError
from harness.play.machine.capabilities import Requirement
from netem.errors import NetemError
from netem.estimates import Estimate, Heard
from netem.lab import EngineName
from netem.measure import Measured, Observer, Study, measure, studies
from netem.observers import in_lab

_SHOWN = {"": (100.0, "%"), "s": (1000.0, "ms"), "bit/s": (0.001, "kbit/s"), "packets": (1.0, "packets")}
"""How people read a unit of `netem.measure`: times what, and its name."""


def measure_engines(requirements: Iterable[Requirement], say: Callable[[str], None]) -> list[Measured]:
    """Measure every engine that works here, 10 to 30 seconds each; MachineError if the machine is too busy for it."""
    working = {requirement.name for requirement in requirements if requirement.ok}
    engines = [engine for engine in get_args(EngineName) if engine in working]
    try:
        return [measure(engine, studies(engine), _telling(engine, in_lab(engine), say)) for engine in engines]
    except NetemError as error:
        raise MachineError(str(error)) from None


def _telling(engine: str, observe: Observer, say: Callable[[str], None]) -> Observer:
    """The same observer, which says what it looks at."""

    def observe_and_tell(study: Study, packets: int) -> Mapping[tuple[int, int], Heard]:
        asked = len(study.questions)
        say(f"{engine}: {packets} packets for {asked} question{'' if asked == 1 else 's'}")
        return observe(study, packets)

    return observe_and_tell


@contextlib.contextmanager
def saying(console: Console) -> Iterator[Callable[[str], None]]:
    """A function that says what goes on: on one line of a terminal, which is gone afterwards, else in lines."""
    if not console.is_terminal:
        yield lambda words: console.print(words, highlight=False, soft_wrap=True)
        return
    with console.status("") as status:
        yield status.update


def render(engines: Sequence[Measured]) -> RenderableType:
    """A table for each engine, a row for each question, and how late the machine was by itself."""
    return Group(*(part for measured in engines for part in (_table(measured), Text(_lateness(measured), style="dim"))))


def _table(measured: Measured) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    table.add_column(measured.engine)
    table.add_column("", no_wrap=True)
    for title in ("asked", "measured", "99.9 % interval", "packets"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in measured.rows:
        mark = Text("✔", style="green") if row.ok else Text("✘", style="bold red")
        factor, unit = _SHOWN[row.question.unit]
        asked = f"{row.question.asked * factor:.4g} {unit}"
        table.add_row(mark, row.question.condition, row.question.quantity, asked, *_found(row.answer, factor))
        if row.before:
            table.add_row("", "", "at first", "", *_found(row.before, factor), style="dim")
    return table


def _found(answer: Estimate, factor: float) -> tuple[str, str, str]:
    interval = f"{answer.low * factor:.4g} to {answer.high * factor:.4g}"
    return f"{answer.measured * factor:.4g}", interval, str(answer.packets)


def _lateness(measured: Measured) -> str:
    late = measured.to_json()["lateness"]
    way, timers = (
        f"{late[key]['median_s'] * 1000:.2g} ms (1 in 100: {late[key]['p99_s'] * 1000:.2g} ms or more)"
        for key in ("way", "timers")
    )
    return f"{measured.engine}: this machine by itself took {way} on the way, and its timers were {timers} late"
