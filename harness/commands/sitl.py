"""Implement `ucp-harness sitl`, which installs and lists the simulator binaries of ArduPilot in the user's cache."""

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

from harness.commands.terminal import output
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
    console = output()
    try:
        with _DownloadBar(console, BINARIES[vehicle]) as bar:
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
    binaries = [binary for vehicle in VEHICLE_TYPES for binary in _available_binaries(vehicle)]
    if as_json:
        sys.stdout.write(json.dumps([asdict(binary) for binary in binaries], indent=1) + "\n")
        return
    console = output()
    for binary in binaries:
        build = f"{binary.version or '-'}{f' ({binary.commit})' if binary.commit else ''}"
        what = f"{binary.vehicle:<7} {build:<21} {megabytes(binary.size_bytes):>8}"
        date, source = (binary.fetched_at or "-")[:10], f"{binary.source}{', current' if binary.current else ''}"
        state = Text(binary.problem, style="red") if binary.problem else Text("ok", style="green")
        console.print(Text.assemble(f"{what}  {date:<10}  {source}: {binary.path}  ", state), soft_wrap=True)
    if not binaries:
        console.print(f"no ArduPilot binaries: run {install_command('copter')}", highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _AvailableBinary:
    """A simulator binary on this machine, as `list --json` prints it."""

    vehicle: VehicleType
    source: str
    path: str
    size_bytes: int
    version: str | None = None
    commit: str | None = None
    """First digits of the hash of the git commit from which the binary was built."""
    sha256: str | None = None
    defaults: str | None = None
    """Path of the default parameters."""
    fetched_at: str | None = None
    """Time of the download. Only for a binary in the cache."""
    current: bool = False
    problem: str | None = None


def _available_binaries(vehicle: VehicleType) -> Iterator[_AvailableBinary]:
    name = BINARIES[vehicle]
    named = Path(os.environ[ENVIRONMENT]) / name if os.environ.get(ENVIRONMENT) else None
    on_path = shutil.which(name)
    for source, binary in ((ENVIRONMENT, named), ("PATH", on_path and Path(on_path))):
        if binary and binary.is_file():
            problem = None if os.access(binary, os.X_OK) else f"{name} is not executable"
            yield _AvailableBinary(
                vehicle, source, str(binary), binary.stat().st_size, **_build_details(vehicle, binary), problem=problem
            )
    for installed in all_installed(vehicle, os.environ):
        yield _AvailableBinary(
            vehicle,
            "cache",
            str(installed.directory),
            sum(path.stat().st_size for path in installed.directory.iterdir()),
            **{**_build_details(vehicle, installed.binary), "version": installed.directory.name},
            fetched_at=installed.manifest.fetched_at if installed.manifest else None,
            current=installed.is_current,
            problem=installed.damage,
        )


def _build_details(vehicle: VehicleType, binary: Path) -> dict[str, Any]:
    build, defaults = build_of(binary), default_parameters(binary, DEFAULTS[vehicle])
    return {
        "version": build.number if build else None,
        "commit": build.commit if build else None,
        "sha256": sha256(binary) if os.access(binary, os.R_OK) else None,
        "defaults": str(defaults) if defaults else None,
    }


class _DownloadBar:
    """A progress bar for a download on a terminal. Without a terminal, it only reports that the command waits for
    another installation.
    """

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
