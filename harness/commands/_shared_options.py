"""Define options and arguments that several commands share."""

import contextlib
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness.errors import MachineError, RunDirectoryError, ScenarioError, extra

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.opening import DatagramOpener
    from ucp.secure.sealing import Depot

RARE = "Rare options"
"""Title of the help panel for options that are rarely needed. The help shows this panel below the other panels."""

BundleOption = Annotated[
    Path | None,
    typer.Option("--bundle", help="Key bundle of any vehicle, to read a secured mission."),
]


_DURATION = re.compile(r"(\d{1,9}(?:\.\d{1,6})?)(s|m|h|)")
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}
MAX_TIME_S = 31 * 86400.0


def seconds_of(option: str, text: str) -> float:
    """Return the number of seconds in a time such as 90s, 30m or 8h. Raises BadParameter, which names the option."""
    duration = _DURATION.fullmatch(text.strip())
    seconds = float(duration[1]) * _UNITS[duration[2]] if duration else 0.0
    if not 0 < seconds <= MAX_TIME_S:
        raise typer.BadParameter(f"{option} {text!r} is not a time: give a time such as 90s, 30m or 8h, up to 31 days")
    return seconds


def complete_scenario(typed: str) -> list[str]:
    """Return completions for a scenario argument: names of included scenarios, YAML files and directories."""
    from harness.scenario.load import scenario_names

    beside = Path(typed).parent if not typed.endswith("/") else Path(typed)
    files = [f"{path}/" if path.is_dir() else str(path) for path in beside.glob("*") if _may_hold_scenario(path)]
    return [word for word in [*scenario_names(), *sorted(files)] if word.startswith(typed)]


def _may_hold_scenario(path: Path) -> bool:
    return not path.name.startswith(".") and (path.is_dir() or path.suffix in (".yaml", ".yml"))


def opener_of(bundle: Path | None) -> "DatagramOpener | None":
    """Return an object that decrypts the datagrams of a secured mission with this key bundle. Return None without a
    bundle. Raises KeysError, MachineError.
    """
    if bundle is None:
        return None
    with extra("secure", "--bundle"):
        from harness.play.keyring import KeysError
        from ucp.secure.bundle import load_bundle
        from ucp.secure.keyfile import KeyFileError
        from ucp.secure.opening import DatagramOpener
    try:
        return DatagramOpener(load_bundle(bundle))
    except KeyFileError as error:
        raise KeysError(f"--bundle: {error}") from None


DepotKey = Annotated[
    Path | None,
    typer.Option("--depot-key", help="Depot key from `keys new`, to read sealed event data."),
]


def depot_of(path: Path | None) -> "Depot | None":
    """Read the depot key from a file. The key decrypts event data. Return None without a path. Raises KeysError,
    MachineError.
    """
    if path is None:
        return None
    with extra("secure", "--depot-key"):
        from harness.play.keyring.key_directory import load_depot_key
    return load_depot_key(path)


KeysOption = Annotated[
    Path | None,
    typer.Option("--keys", help="Your own copy of the public keys, or their directory."),
]


def trusted_keys(path: Path | None) -> "PublicKeys | None":
    """Return the public keys that the user trusts, from a file or directory. Return None without a path.

    Raises KeysError, MachineError.
    """
    if path is None:
        return None
    try:
        from harness.play.keyring import KeysError
        from ucp.secure.bundle import PUBLIC_NAME, load_public
        from ucp.secure.keyfile import KeyFileError
    except ModuleNotFoundError:
        raise MachineError("--keys needs the package cryptography: run `pip install 'ucp-harness[secure]'`") from None
    try:
        return load_public(path / PUBLIC_NAME if path.is_dir() else path)
    except KeyFileError as error:
        raise KeysError(f"--keys: {error}") from None


def roster_of(text: str) -> int | list[int]:
    """Return the value of the scenario key `agents` for this text of the user: a number, or a list of IDs. Raises
    ScenarioError.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdecimal() and len(part) < 10 for part in parts):
        raise ScenarioError(f"`--agents` is {text!r}: use a number of agents, or IDs such as 10,28,32")
    return int(parts[0]) if len(parts) == 1 else [int(part) for part in parts]


def refuse_existing(paths: Iterable[Path]) -> None:
    """Raise RunDirectoryError if an output file already exists. A command calls this function before a long
    computation, because it could not write the results afterwards.
    """
    for path in paths:
        if path.exists():
            raise RunDirectoryError(f"{path} exists: choose another file; existing files are not overwritten")


def write_new(path: Path, parts: Iterable[str]) -> None:
    """Write the text `parts` to a new file.

    Raises RunDirectoryError if the file exists or cannot be created, and MachineError if writing fails.
    """
    try:
        file = path.open("x", encoding="utf-8", newline="")
    except FileExistsError:
        raise RunDirectoryError(f"{path} exists: choose another file; existing files are not overwritten") from None
    except OSError as error:
        raise RunDirectoryError(f"{path} cannot be created: {error.strerror}; choose another file") from None
    try:
        with file:
            file.writelines(parts)
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def write_whole(path: Path) -> Iterator[None]:
    """Let the caller write a new file or directory inside the context. If the caller fails, remove the incomplete
    output.

    Raises RunDirectoryError if `path` exists or cannot be created, and MachineError if writing fails.
    """
    refuse_existing([path])
    if not path.absolute().parent.is_dir():
        raise RunDirectoryError(f"{path} cannot be created: its directory does not exist; choose another file")
    try:
        yield
    except FileExistsError:
        raise RunDirectoryError(f"{path} exists: choose another file; existing files are not overwritten") from None
    except BaseException as error:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise MachineError(f"{path} cannot be written: {error.strerror}") from None
        raise
