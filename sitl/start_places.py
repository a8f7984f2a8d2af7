"""Read start positions from files in ArduPilot's formats: a file of named locations, and a file with the offset of each
vehicle in a swarm.

    locations.txt      CMAC=-35.363261,149.165230,584,353     latitude, longitude, metres above sea level, heading
    swarminit.txt      1=20,-20,0,90                          instance; metres east, north and up, optional heading

Lines may end with a comment, `# ...`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from sitl._text_file import text_of
from sitl.vehicle import Home, VehicleError

LOCATIONS = "locations.txt"
MAX_BYTES = 1_000_000
MAX_INSTANCE = 10_000
MAX_OFFSET_M = 100_000.0  # up to this distance, a flat earth is accurate enough
MAX_SHOWN = 60


class PlaceError(VehicleError):
    """An error: a location is missing, or a file of locations cannot be read."""


class HomeOffset(NamedTuple):
    """An offset in metres from the first home position. If `heading_deg` is None, the vehicle has the heading of the
    first home position.
    """

    east_m: float
    north_m: float
    up_m: float
    heading_deg: float | None = None

    def of(self, home: Home) -> Home:
        """Return the place at this offset from `home`. Raises VehicleError if the place is not on Earth."""
        if not all(math.isfinite(part) and abs(part) <= MAX_OFFSET_M for part in self[:3]):
            raise PlaceError(f"an offset in metres is at most {MAX_OFFSET_M:g} each way")
        there = home.offset(self.north_m, self.east_m)
        heading = home.heading_deg if self.heading_deg is None else self.heading_deg % 360
        return Home(there.lat_deg, there.lon_deg, home.alt_m + self.up_m, heading)


def named(name: str, beside: Path | None, environ: Mapping[str, str]) -> Home:
    """Return the location with this name from the first file that contains the name. Raises VehicleError."""
    files = [path for path in _files(beside, environ) if path.is_file()]
    known: set[str] = set()
    for path in files:
        for number, key, values in _lines(path):
            if key == name:
                return _home(path, number, values)
            known.add(key)
    if not files:
        tried = ", ".join(map(str, _files(beside, environ)))
        raise PlaceError(f"no file of named locations found: searched {tried}")
    nearest = get_close_matches(name, known, n=1)
    meant = f": did you mean {nearest[0]}?" if nearest else ""
    raise PlaceError(f"no such location in {', '.join(map(str, files))}{meant}")


def swarm(path: Path) -> dict[int, HomeOffset]:
    """Return the offsets of the vehicles of a swarm by vehicle number, from 0. Raises VehicleError."""
    offsets: dict[int, HomeOffset] = {}
    for number, key, values in _lines(path):
        where = f"{path}, line {number}"
        if not (key.isascii() and key.isdecimal() and int(key[:9]) <= MAX_INSTANCE):
            raise PlaceError(f"{where}: {key[:MAX_SHOWN]!r} is not an instance: write INSTANCE=EAST,NORTH,UP,HEADING")
        numbers = _numbers(values)
        if numbers is None or len(numbers) not in (3, 4):
            raise PlaceError(f"{where}: {values[:MAX_SHOWN]!r} is not EAST,NORTH,UP,HEADING in metres and degrees")
        offsets.setdefault(int(key), HomeOffset(*numbers))
    if not offsets:
        raise PlaceError(f"{path} has no offsets in it: write INSTANCE=EAST,NORTH,UP,HEADING")
    return offsets


def _files(beside: Path | None, environ: Mapping[str, str]) -> Iterator[Path]:
    """Yield the files that may exist: next to the scenario, in the user's own directory, and next to the binaries."""
    if beside is not None:
        yield beside / LOCATIONS
    home = Path(environ.get("HOME", "."))
    yield Path(environ.get("XDG_CONFIG_DIR", home / ".config")) / "ardupilot" / LOCATIONS
    if binaries := environ.get("ARDUPILOT_SITL"):
        for directory in autotest(Path(binaries)):
            yield directory / LOCATIONS


def autotest(binaries: Path) -> Iterator[Path]:
    """Yield the possible directories of ArduPilot's files: next to the binaries, and in the source tree that built
    them.
    """
    yield binaries
    if binaries.parts[-3:] == ("build", "sitl", "bin"):
        yield binaries.parents[2] / "Tools" / "autotest"


def _lines(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield the number, key and values of each line that is not empty. Raises VehicleError."""
    for number, line in enumerate(text_of(path, MAX_BYTES).splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if not content:
            continue
        key, equals, values = content.partition("=")
        if not equals:
            raise PlaceError(f"{path}, line {number}: {content[:MAX_SHOWN]!r} has no = in it")
        yield number, key.strip(), values


def _home(path: Path, number: int, values: str) -> Home:
    numbers = _numbers(values)
    if numbers is None or len(numbers) != 4:
        raise PlaceError(f"{path}, line {number}: {values[:MAX_SHOWN]!r} is not LATITUDE,LONGITUDE,ALTITUDE,HEADING")
    try:
        return Home(numbers[0], numbers[1], numbers[2], numbers[3] % 360)
    except VehicleError as error:
        raise PlaceError(f"{path}, line {number}: {error}") from None


def _numbers(values: str) -> list[float] | None:
    try:
        numbers = [float(value) for value in values.split(",")]
    except ValueError:
        return None
    return numbers if all(map(math.isfinite, numbers)) else None
