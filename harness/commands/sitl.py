"""`ucp-harness sitl install`, `list` and `path`: ArduPilot's SITL binaries, from its server into the user's cache."""

import json
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn
from rich.text import Text

from harness.errors import HarnessError, InterruptedRunError, MachineError
from sitl.airframes import BINARIES, DEFAULTS
from sitl.ardupilot import ENVIRONMENT, build_of, default_parameters
from sitl.download import megabytes
from sitl.firmware import RequestError, install
from sitl.installed import all_installed, current, install_command, sha256
from sitl.vehicle import VEHICLE_TYPES, VehicleError, VehicleType

app = typer.Typer(no_args_is_help=True, help="Install and list ArduPilot's SITL binaries.")

Vehicle = Annotated[VehicleType, typer.Option(help="Type of vehicle.")]


@app.command("install")
def install_into_cache(
    vehicle: Vehicle = "copter",
    version: Annotated[str, typer.Option(help="stable, beta, latest, or a number such as 4.6.3.")] = "stable",
    url: Annotated[
        str | None,
        typer.Option(
            envvar="UCP_SITL_URL",
            help="Mirror of firmware.ardupilot.org and raw.githubusercontent.com.",
        ),
    ] = None,
) -> None:
    """Download a SITL binary and its default parameters.

    The binary is for Linux on x86_64 or ARM, and goes into the user's cache.
    """
    console = Console()
    try:
        with _Bar(console, BINARIES[vehicle]) as bar:
            outcome = install(vehicle, version, os.environ, bar, url)
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted; repeat the command to continue") from None
    except RequestError as error:
        raise HarnessError(str(error)) from None
    except VehicleError as error:
        raise MachineError(str(error)) from None
    directory = outcome.installed.directory
    done = "is installed already" if outcome.already else "is installed"
    console.print(f"{vehicle} {directory.name} {done}: {directory}", highlight=False, soft_wrap=True)


@app.command("path")
def print_path(vehicle: Vehicle = "copter") -> None:
    """Print the directory of the binary, for ARDUPILOT_SITL."""
    try:
        installed = current(vehicle, os.environ)
    except VehicleError as error:
        raise MachineError(str(error)) from None
    if installed is None:
        raise MachineError(f"no {vehicle} is installed: run {install_command(vehicle)}")
    sys.stdout.write(f"{installed.directory}\n")


@app.command("list")
def list_binaries(
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List the available SITL binaries, first choice first.

    A run searches ARDUPILOT_SITL, then PATH, then the cache.
    """
    offers = [offer for vehicle in VEHICLE_TYPES for offer in _offers(vehicle)]
    if as_json:
        sys.stdout.write(json.dumps([asdict(offer) for offer in offers], indent=1) + "\n")
        return
    console = Console()
    for offer in offers:
        build = f"{offer.version or '-'}{f' ({offer.commit})' if offer.commit else ''}"
        what = f"{offer.vehicle:<7} {build:<21} {megabytes(offer.size_bytes):>8}"
        date, source = (offer.fetched_at or "-")[:10], f"{offer.source}{', current' if offer.current else ''}"
        state = Text(offer.problem, style="red") if offer.problem else Text("ok", style="green")
        console.print(Text.assemble(f"{what}  {date:<10}  {source}: {offer.path}  ", state), soft_wrap=True)
    if not offers:
        console.print(f"no ArduPilot binaries: run {install_command('copter')}", highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _Offer:
    """A binary that is here; `fetched_at` is known of installed ones, `commit` by its first digits."""

    vehicle: VehicleType
    source: str
    path: str
    size_bytes: int
    version: str | None = None
    commit: str | None = None
    sha256: str | None = None
    defaults: str | None = None
    """Its default parameters."""
    fetched_at: str | None = None
    current: bool = False
    problem: str | None = None


def _offers(vehicle: VehicleType) -> Iterator[_Offer]:
    name = BINARIES[vehicle]
    named = Path(os.environ[ENVIRONMENT]) / name if os.environ.get(ENVIRONMENT) else None
    on_path = shutil.which(name)
    for source, binary in ((ENVIRONMENT, named), ("PATH", on_path and Path(on_path))):
        if binary and binary.is_file():
            problem = None if os.access(binary, os.X_OK) else f"{name} is not executable"
            yield _Offer(
                vehicle, source, str(binary), binary.stat().st_size, **_built(vehicle, binary), problem=problem
            )
    for installed in all_installed(vehicle, os.environ):
        yield _Offer(
            vehicle,
            "cache",
            str(installed.directory),
            sum(path.stat().st_size for path in installed.directory.iterdir()),
            **{**_built(vehicle, installed.binary), "version": installed.directory.name},
            fetched_at=installed.manifest.fetched_at if installed.manifest else None,
            current=installed.is_current,
            problem=installed.damage,
        )


def _built(vehicle: VehicleType, binary: Path) -> dict[str, Any]:
    build, defaults = build_of(binary), default_parameters(binary, DEFAULTS[vehicle])
    return {
        "version": build.number if build else None,
        "commit": build.commit if build else None,
        "sha256": sha256(binary) if os.access(binary, os.R_OK) else None,
        "defaults": str(defaults) if defaults else None,
    }


class _Bar:
    """A progress bar on a terminal; elsewhere nothing but that another install has to end first."""

    def __init__(self, console: Console, what: str) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn())
        rates = (TransferSpeedColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, *rates, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._progress.add_task(what, total=None)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def waits(self) -> None:
        self._progress.console.print("waiting for another install to end", highlight=False)

    def downloads(self, done: int, total: int) -> None:
        self._progress.update(self._task, completed=done, total=total)
