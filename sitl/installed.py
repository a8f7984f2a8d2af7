"""Manage the cache of ArduPilot SITL binaries, which `ucp-harness sitl install` fills, and check its integrity.

    $XDG_CACHE_HOME/ucp-harness/sitl/copter/4.6.3/arducopter      (XDG Base Directory Specification; else ~/.cache)
                                                  copter.parm     ArduPilot's default parameters of that commit
                                                  copter-hexa.parm, ...                    and those of its frames
                                                  manifest.json   `DownloadManifest`
                                           current -> 4.6.3       the version that runs use

ArduPilot's server publishes no checksums. Therefore the SHA-256 hash of each file is recorded after its download over
TLS, and compared before use.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

from sitl.airframes import BINARIES, DEFAULTS
from sitl.vehicle import UnusableBinaryError, VehicleError, VehicleType

MANIFEST = "manifest.json"
CURRENT = "current"


@dataclass(frozen=True)
class DownloadedFile:
    """A downloaded file. Its size is in bytes."""

    url: str
    size: int
    sha256: str

    @classmethod
    def of(cls, path: Path, url: str) -> DownloadedFile:
        return cls(url, path.stat().st_size, sha256(path))


@dataclass(frozen=True)
class DownloadManifest:
    """The list of downloaded files, with ArduPilot's version and git commit. `fetched_at` is the time of the download
    (ISO 8601, UTC).
    """

    vehicle: str
    version: str
    commit: str
    fetched_at: str
    files: dict[str, DownloadedFile]

    def write(self, directory: Path) -> None:
        (directory / MANIFEST).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def read(cls, directory: Path) -> DownloadManifest:
        """Return the manifest of a directory.

        Raises OSError, ValueError, TypeError, LookupError or AttributeError if the manifest is missing or damaged.
        """
        document = json.loads((directory / MANIFEST).read_text())
        files = {
            name: DownloadedFile(str(file["url"]), int(file["size"]), str(file["sha256"]))
            for name, file in document["files"].items()
        }
        return cls(**{**document, "files": files})


@dataclass(frozen=True)
class InstalledVersion:
    """One installed version for one vehicle type."""

    vehicle: VehicleType
    directory: Path

    @property
    def binary(self) -> Path:
        return self.directory / BINARIES[self.vehicle]

    @property
    def is_current(self) -> bool:
        """True if runs use this version."""
        with contextlib.suppress(OSError):
            return (self.directory.parent / CURRENT).readlink() == Path(self.directory.name)
        return False

    @cached_property
    def manifest(self) -> DownloadManifest | None:
        """The list of downloaded files, or None if it cannot be read."""
        with contextlib.suppress(OSError, ValueError, TypeError, LookupError, AttributeError):
            return DownloadManifest.read(self.directory)
        return None

    @cached_property
    def damage(self) -> str | None:
        """A description of the first problem with the installed files, such as a change after the download. None if all
        files are intact. Each use of this property reads all files.
        """
        if self.manifest is None:
            return f"{MANIFEST} is missing or cannot be read"
        for name in dict.fromkeys((self.binary.name, DEFAULTS[self.vehicle], *self.manifest.files)):
            recorded = self.manifest.files.get(name)
            try:
                if recorded is None or sha256(self.directory / name) != recorded.sha256:
                    return f"{name} is not the file that was fetched (SHA-256)"
            except OSError as error:
                return f"{name} cannot be read ({error.strerror})"
        return None if os.access(self.binary, os.X_OK) else f"{self.binary.name} is not executable"


def cache(environ: Mapping[str, str]) -> Path:
    """Return the directory of the cache. Raises VehicleError if the environment does not determine it."""
    for base in (Path(environ.get("XDG_CACHE_HOME", "")), Path(environ.get("HOME", "")) / ".cache"):
        if base.is_absolute():
            return base / "ucp-harness" / "sitl"
    raise VehicleError("no directory for a cache: set XDG_CACHE_HOME to the absolute path of a directory")


def all_installed(vehicle: VehicleType, environ: Mapping[str, str]) -> list[InstalledVersion]:
    """Return all installed versions, sorted by name."""
    try:
        directories = sorted(path for path in (cache(environ) / vehicle).iterdir() if not path.name.startswith("."))
    except (OSError, VehicleError):
        return []
    return [InstalledVersion(vehicle, path) for path in directories if path.is_dir() and not path.is_symlink()]


def current(vehicle: VehicleType, environ: Mapping[str, str]) -> InstalledVersion | None:
    """Return the version that was installed last, or None if no version is installed. Raises UnusableBinaryError if the
    version is damaged.
    """
    try:
        directory = (cache(environ) / vehicle / CURRENT).resolve(strict=True)
    except (OSError, VehicleError):
        return None
    version = InstalledVersion(vehicle, directory)
    if version.damage:
        raise UnusableBinaryError(f"{directory} is damaged, {version.damage}: run {install_command(vehicle)}")
    return version


def install_command(vehicle: VehicleType) -> str:
    return f"`ucp-harness sitl install --vehicle {vehicle}`"


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
