"""Find out which runs are possible on this machine, and measure how accurately its network applies conditions."""

import contextlib
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, get_args

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from harness import compiled
from harness.errors import MachineError
from netem import lab_doctor, uml
from netem.errors import NetemError, UmlError
from netem.estimates import Estimate, ReceivedStream
from netem.lab import EngineName
from netem.measure import EngineMeasurement, NetworkStudy, Observer, measure, studies
from netem.observers import in_lab
from sitl.ardupilot import ArduPilot
from sitl.vehicle import VehicleError


@dataclass(frozen=True)
class MachineRequirement:
    """A property that this machine needs to carry out runs."""

    name: str
    ok: bool
    needed: bool
    """True if no run is possible without the property."""
    detail: str
    way_out: str | None = None
    """The remedy for a machine without the property."""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def examine() -> list[MachineRequirement]:
    """Return all requirements, each with the result of its check. To check the kernel, the function builds and removes
    a small virtual network.
    """
    python = MachineRequirement(
        "Python", sys.version_info >= (3, 11), True, platform.python_version(), "install Python 3.11 or newer"
    )
    lab = [
        MachineRequirement(
            requirement.name, requirement.ok, requirement.needed, requirement.detail, requirement.way_out
        )
        for requirement in lab_doctor.examine()
    ]
    modules = MachineRequirement("Modules", True, False, compiled.in_use)
    return [python, modules, *lab, _user_mode_linux(), _docker(), _ardupilot()]


def _user_mode_linux() -> MachineRequirement:
    use = "--kernel uml: all of netem, in a process without privileges"
    if uml.inside():
        return MachineRequirement("User Mode Linux", True, False, "this is it")
    try:
        return MachineRequirement("User Mode Linux", True, False, f"{uml.examine()}; for {use}")
    except UmlError as error:
        return MachineRequirement("User Mode Linux", False, False, str(error), f"it enables {use}")


def _docker() -> MachineRequirement:
    from harness.play.containers._container_preflight import require_root
    from harness.play.containers.docker_engine import DockerEngine, DockerError

    use = "--backend docker: vehicles and agents in containers"
    try:
        engine = DockerEngine.connect()
        version = engine.api.version()["Version"]
        engine.close()
        require_root()
    except DockerError as error:
        return MachineRequirement("Docker", False, False, str(error), f"it enables {use}")
    return MachineRequirement("Docker", True, False, f"{version}, for {use}")


def _ardupilot() -> MachineRequirement:
    try:
        ardupilot = ArduPilot.find(None, os.environ)
    except VehicleError as error:
        return MachineRequirement(
            "ArduPilot SITL", False, False, f"{error}", "without it runs use the embedded vehicle"
        )
    if ardupilot.defaults is None:
        way_out = (
            "put ArduPilot's default parameters, copter.parm, in the same directory: without them the vehicle "
            "may refuse to arm"
        )
        return MachineRequirement("ArduPilot SITL", False, False, f"{ardupilot.binary}, without copter.parm", way_out)
    return MachineRequirement("ArduPilot SITL", True, False, str(ardupilot.binary))


_SHOWN = {"": (100.0, "%"), "s": (1000.0, "ms"), "bit/s": (0.001, "kbit/s"), "packets": (1.0, "packets")}
"""Unit of a measured value -> the factor and the unit for display. For example, 0.02 s is displayed as 20 ms."""


def measure_engines(requirements: Iterable[MachineRequirement], say: Callable[[str], None]) -> list[EngineMeasurement]:
    """Measure the accuracy of each network engine that works on this machine. Each measurement takes 10 to 30 seconds.
    Raises MachineError if the machine is too busy.
    """
    working = {requirement.name for requirement in requirements if requirement.ok}
    engines = [engine for engine in get_args(EngineName) if engine in working]
    try:
        return [measure(engine, studies(engine), _with_progress(engine, in_lab(engine), say)) for engine in engines]
    except NetemError as error:
        raise MachineError(str(error)) from None


def _with_progress(engine: str, observe: Observer, say: Callable[[str], None]) -> Observer:
    """Return an observer that reports each measurement to the user, and then carries it out by calling `observe`."""

    def observe_and_report(study: NetworkStudy, packets: int) -> Mapping[tuple[int, int], ReceivedStream]:
        asked = len(study.questions)
        say(f"{engine}: {packets} packets for {asked} question{'' if asked == 1 else 's'}")
        return observe(study, packets)

    return observe_and_report


@contextlib.contextmanager
def progress_line(console: Console) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows progress. On a terminal, each text replaces the previous one. Without a terminal, the
    function prints each text as a line.
    """
    if not console.is_terminal:
        yield lambda words: console.print(words, highlight=False, soft_wrap=True)
        return
    with console.status("") as status:
        yield status.update


def render(engines: Sequence[EngineMeasurement]) -> RenderableType:
    """Return a table for each network engine, with a row for each measured network condition, and a line about the
    machine's delays.
    """
    return Group(*(part for measured in engines for part in (_table(measured), Text(_lateness(measured), style="dim"))))


def _table(measured: EngineMeasurement) -> Table:
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
        table.add_row(mark, row.question.condition, row.question.quantity, asked, *_result_texts(row.answer, factor))
        if row.before:
            table.add_row("", "", "at first", "", *_result_texts(row.before, factor), style="dim")
    return table


def _result_texts(answer: Estimate, factor: float) -> tuple[str, str, str]:
    interval = f"{answer.low * factor:.4g} to {answer.high * factor:.4g}"
    return f"{answer.measured * factor:.4g}", interval, str(answer.packets)


def _lateness(measured: EngineMeasurement) -> str:
    late = measured.to_json()["lateness"]
    latency, timers = (
        f"{late[key]['median_s'] * 1000:.2g} ms (1 in 100: {late[key]['p99_s'] * 1000:.2g} ms or more)"
        for key in ("way", "timers")
    )
    return (
        f"{measured.engine}: without conditions, packets took {latency} on this machine, and its "
        f"timers were {timers} late"
    )
