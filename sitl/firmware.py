"""Install ArduPilot's SITL binaries for Linux into the cache of the user.

The firmware server has a statically linked binary at VEHICLE/RELEASE/BOARD/, and `git-version.txt` with its commit and
version. RELEASE is stable, beta, latest, or for example stable-4.6.3. BOARD is SITL_x86_64_linux_gnu or
SITL_arm_linux_gnueabihf. ArduPilot has no other SITL boards (Tools/scripts/board_list.py). An aarch64 machine uses the
second one if it can run 32-bit programs. The default parameters of the vehicle and its frames come from ArduPilot's
source tree at the same commit. A tag is not sufficient: `latest` has none, and the binary of 4.6.3 was built from the
commit before its tag. A mirror (`base`) replaces both hosts, with the same paths.

This module was written without access to the server, from ArduPilot's build scripts and from published listings. It
therefore does not rely on the following properties of the server. If the server sends no version mark of a file (ETag
or Last-Modified), an interrupted download is not resumed. If it does not support ranges, the download restarts. If its
listings have an unexpected form, an error message does not list the available versions. The server publishes no
checksums.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from sitl.airframes import BINARIES, DEFAULTS, stacked
from sitl.download import STALL_S, DownloadError, NotThereError, UnreachableError, download, fetch_text
from sitl.installed import CURRENT, DownloadedFile, DownloadManifest, InstalledVersion, cache
from sitl.vehicle import VehicleError, VehicleType

FIRMWARE = "https://firmware.ardupilot.org"
SOURCE = "https://raw.githubusercontent.com"

LIMIT = 100_000_000  # bytes; a binary has about 7 MB
TEXT_LIMIT = 1_000_000  # bytes
HELP_S = 10.0
"""Time limit in seconds for a test run of a program with `--help`. A program that still runs after this time has
started, so this machine can run it.
"""

# Where the source tree keeps a vehicle's defaults; the plane's have moved.
_AUTOTEST = "Tools/autotest"
_PARAMETERS: dict[VehicleType, tuple[str, ...]] = {
    "copter": ("default_params/copter.parm",),
    "plane": ("models/plane.parm", "default_params/plane.parm"),
    "rover": ("default_params/rover.parm",),
}
_NEWEST_NAMED = 10  # versions

_NUMBER = re.compile(r"\d+\.\d+\.\d+")


@dataclass(frozen=True)
class _ProcessorKind:
    """A kind of processor: its directory on the server, and the beginning of an ELF file for it."""

    directory: str
    processor: str
    header: re.Pattern[bytes]


_X86_64 = _ProcessorKind("SITL_x86_64_linux_gnu", "x86_64", re.compile(rb"\x7fELF\x02\x01.{12}\x3e\x00", re.DOTALL))
_ARM = _ProcessorKind("SITL_arm_linux_gnueabihf", "32-bit ARM", re.compile(rb"\x7fELF\x01\x01.{12}\x28\x00", re.DOTALL))
_BOARDS = {"x86_64": _X86_64, "aarch64": _ARM, "armv7l": _ARM}
"""Value of platform.machine() -> board. Binaries for both boards are little endian. The first has 64 bits and e_machine
62. The second has 32 bits and e_machine 40.
"""
_FROM_SOURCE = "build ArduPilot SITL from source and set ARDUPILOT_SITL to its directory"


class RequestError(VehicleError):
    """An error: the requested version or address does not exist."""


class CacheError(VehicleError):
    """An error: the cache cannot be written."""


class InstallWatcher(Protocol):
    """An object that is informed about the progress of an installation."""

    def waits(self) -> None:
        """Report that the installation waits, because another process is installing a binary for this vehicle."""

    def downloads(self, done: int, total: int) -> None:
        """Report the progress of the download: the number of downloaded bytes, and the size of the binary."""


@dataclass(frozen=True)
class InstallOutcome:
    """The result of an installation. `installed` is the version. `already` is true if it had been installed before."""

    installed: InstalledVersion
    already: bool


@dataclass(frozen=True)
class _FirmwareBuild:
    """The version and commit in the file `git-version.txt`."""

    version: str
    commit: str

    @property
    def name(self) -> str:
        """The name of the directory. It contains the commit, because development versions may share a version
        number.
        """
        return self.version if _NUMBER.fullmatch(self.version) else f"{self.version}-{self.commit[:8]}"


def install(
    vehicle: VehicleType,
    version: str,
    environ: Mapping[str, str],
    watcher: InstallWatcher,
    base: str | None = None,
    stall_s: float = STALL_S,
) -> InstallOutcome:
    """Install the binary and the default parameters of a vehicle, unless they are in the cache. Runs then use this
    version.

    `version` is `stable`, `beta`, `latest` or a number such as 4.6.3. If a version with this number is already
    installed, no server is needed. An interrupted installation is resumed. Parameter files of frames are included if
    the version has them.

    Raises RequestError for a version or a `base` that does not exist, DownloadError if a download fails, CacheError if
    the cache cannot be written, and VehicleError if this machine cannot run the binary.
    """
    if not re.fullmatch(r"[a-z0-9][\w.-]*", version, re.ASCII):
        raise RequestError(f"{version!r} is not a version: give stable, beta, latest or a number such as 4.6.3")
    board = _BOARDS.get(platform.machine()) if sys.platform == "linux" else None
    if board is None:
        raise VehicleError(
            f"ArduPilot publishes SITL for Linux on x86_64 and 32-bit ARM, and this is {sys.platform} on "
            f"{platform.machine()}: {_FROM_SOURCE}"
        )
    server = _ReleaseServer(vehicle, version, board, base, stall_s)
    home = cache(environ) / vehicle
    with _ways_out(home), _locked(home, watcher):
        number = version.removeprefix("stable-")
        if _NUMBER.fullmatch(number) and _intact(vehicle, home / number):
            return _select(InstalledVersion(vehicle, home / number), already=True)
        build = server.build()
        place = home / build.name
        if _intact(vehicle, place):
            return _select(InstalledVersion(vehicle, place), already=True)
        part = home / f".{build.name}.part"
        part.mkdir(exist_ok=True)
        binary = server.fetch_binary(part, watcher)
        files = {BINARIES[vehicle]: binary, **server.fetch_parameters(part, build)}
        fetched_at = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        DownloadManifest(vehicle, build.version, build.commit, fetched_at, files).write(part)
        shutil.rmtree(place, ignore_errors=True)  # damaged
        part.rename(place)
        return _select(InstalledVersion(vehicle, place), already=False)


class _ReleaseServer:
    """One release of one vehicle type, on ArduPilot's server or on the mirror `base`. Raises RequestError if `base` is
    invalid.
    """

    def __init__(
        self, vehicle: VehicleType, version: str, board: _ProcessorKind, base: str | None, stall_s: float
    ) -> None:
        self._vehicle, self._version, self._board, self._stall_s = vehicle, version, board, stall_s
        firmware, self._source = (_checked(base),) * 2 if base else (FIRMWARE, SOURCE)
        self._releases = f"{firmware}/{vehicle.title()}/"
        self._release = f"{self._releases}{f'stable-{version}' if version[0].isdigit() else version}/{board.directory}/"

    def build(self) -> _FirmwareBuild:
        """Return the current build of the release."""
        url = f"{self._release}git-version.txt"
        try:
            text = fetch_text(url, TEXT_LIMIT, self._stall_s)
        except NotThereError:
            raise self._no_such_version() from None
        commit = re.search(r"^commit ([0-9a-f]{40})\b", text, re.MULTILINE)
        version = re.search(r"^APMVERSION: .*V(\d[\w.-]{0,40})\s*$", text, re.MULTILINE | re.ASCII)
        if not (commit and version):
            raise DownloadError(f"{url} does not name a commit and a version: is this ArduPilot's server, or a mirror?")
        return _FirmwareBuild(version[1], commit[1])

    def fetch_binary(self, directory: Path, watcher: InstallWatcher) -> DownloadedFile:
        """Download the binary to `directory` unless it is there, and make it executable."""
        path = directory / BINARIES[self._vehicle]
        url = self._release + path.name
        if not path.exists():
            try:
                download(url, path, LIMIT, watcher.downloads, self._stall_s)
            except NotThereError:
                raise self._no_such_version() from None
        with path.open("rb") as file:
            head = file.read(20)
        if not self._board.header.match(head):
            path.unlink()
            raise DownloadError(
                f"{url} is not a program for Linux on {self._board.processor}, but begins with {head[:12]!r}: "
                "does a proxy answer for it?"
            )
        path.chmod(0o755)
        if platform.machine() == "aarch64":
            _refuse_what_does_not_run(path)
        return DownloadedFile.of(path, url)

    def fetch_parameters(self, directory: Path, build: _FirmwareBuild) -> dict[str, DownloadedFile]:
        """Download the default parameters of the vehicle and its frames at the commit of the binary."""
        own = DEFAULTS[self._vehicle]
        places = {own: _PARAMETERS[self._vehicle]}
        for name in stacked(self._vehicle):
            places[name] = f"default_params/{name}", f"models/{name}"
        fetched = {name: self._fetch_parameters(directory / name, build, paths) for name, paths in places.items()}
        files = {name: file for name, file in fetched.items() if file is not None}
        if own not in files:
            raise DownloadError(f"{self._tree(build)}/{places[own][-1]} does not exist: install another --version")
        return files

    def _tree(self, build: _FirmwareBuild) -> str:
        return f"{self._source}/ArduPilot/ardupilot/{build.commit}/{_AUTOTEST}"

    def _fetch_parameters(self, path: Path, build: _FirmwareBuild, places: tuple[str, ...]) -> DownloadedFile | None:
        """Download a parameter file from the first address that has it. Return None if no address has it."""
        for place in places:
            url = f"{self._tree(build)}/{place}"
            try:
                text = fetch_text(url, TEXT_LIMIT, self._stall_s)
            except NotThereError:
                continue
            if not re.search(r"^[A-Z][A-Z0-9_]*[\s,=]+-?[\d.]", text, re.MULTILINE):
                raise DownloadError(f"{url} has no ArduPilot parameters in it: does a proxy answer for it?")
            path.write_text(text, encoding="utf-8")
            return DownloadedFile.of(path, url)
        return None

    def _no_such_version(self) -> RequestError:
        """Return the error for a release that does not exist. The error lists the existing releases if the server lists
        them.
        """
        try:
            listing = fetch_text(self._releases, TEXT_LIMIT, self._stall_s)
        except DownloadError:
            listing = ""
        names = set(re.findall(r'href="[^"]*?\b(stable-\d+\.\d+\.\d+|stable|beta|latest)/?"', listing))
        numbers = [name.removeprefix("stable-") for name in names if name.startswith("stable-")]
        numbers.sort(key=lambda number: tuple(map(int, number.split("."))), reverse=True)
        known = [name for name in ("stable", "beta", "latest") if name in names] + numbers[:_NEWEST_NAMED]
        way_out = f"there are {', '.join(known)}" if known else f"look at {self._releases} for those that there are"
        return RequestError(f"{self._release} has no {self._vehicle} {self._version}: {way_out}")


def _refuse_what_does_not_run(program: Path) -> None:
    """Raise VehicleError if this machine cannot run the program because it is an aarch64 machine without support for
    32-bit programs.
    """
    try:
        subprocess.run([program, "--help"], capture_output=True, timeout=HELP_S, stdin=subprocess.DEVNULL, check=False)
    except subprocess.TimeoutExpired:
        return
    except OSError as error:
        if error.errno != errno.ENOEXEC:
            raise
        raise VehicleError(
            "for ARM ArduPilot publishes SITL in 32 bits only, and this aarch64 does not run programs of 32 bits: "
            f"{_FROM_SOURCE}"
        ) from None


def _checked(base: str) -> str:
    """Return the address of a mirror without a trailing slash. Raises RequestError."""
    try:
        parts = urlsplit(base)
        plain = re.fullmatch(r"[!-~]+", base) and parts.username is None
        if plain and parts.scheme in ("http", "https") and parts.hostname and parts.port != 0:
            return base.rstrip("/")
    except ValueError:
        pass
    raise RequestError(
        f"{base!r} is not the address of a mirror: give http(s)://HOST[:PORT][/PATH], without a password"
    )


def _intact(vehicle: VehicleType, directory: Path) -> bool:
    return directory.is_dir() and InstalledVersion(vehicle, directory).damage is None


def _select(installed: InstalledVersion, already: bool) -> InstallOutcome:
    """Select this version for runs, and remove unfinished installations."""
    home = installed.directory.parent
    link = home / f".{CURRENT}"
    link.unlink(missing_ok=True)
    link.symlink_to(installed.directory.name)
    link.replace(home / CURRENT)
    for left in home.glob(".*.part"):
        shutil.rmtree(left, ignore_errors=True)
    return InstallOutcome(installed, already)


@contextlib.contextmanager
def _locked(home: Path, watcher: InstallWatcher) -> Iterator[None]:
    """Allow only one installation of a vehicle at a time. The kernel releases the lock when the process ends
    (flock(2)).
    """
    home.mkdir(parents=True, exist_ok=True)
    with (home / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            watcher.waits()
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def _ways_out(home: Path) -> Iterator[None]:
    """Return a context manager that adds a solution to the message of a network error, and converts a disk error to
    CacheError.
    """
    try:
        yield
    except UnreachableError as error:
        raise UnreachableError(
            f"{error}: if there is a mirror, give its address with --url; else install on a machine that can reach it, "
            "copy the directory that `ucp-harness sitl path` names there to this one, and set ARDUPILOT_SITL to it"
        ) from None
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise CacheError(
                f"the disk of {home} is full: free some space, and run the same command again to continue"
            ) from None
        raise CacheError(
            f"{error.filename or home} cannot be written ({error.strerror}): make it writable, or set XDG_CACHE_HOME "
            "to a directory that is"
        ) from None
