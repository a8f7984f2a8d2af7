"""Read ArduPilot's parameter files: `NAME VALUE` or `NAME,VALUE` per line, or the columns of QGroundControl.

The reader limits size and values, because files come from any source. Ground stations can read the written files.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path

from sitl._text_file import text_of
from sitl.vehicle import VehicleError

MAX_BYTES = 1_000_000  # all parameters of an ArduCopter 4.7 have 35 kB
MAX_PARAMETERS = 5_000
MAX_LINE_SHOWN = 60
LARGEST = 3.4028235e38  # largest float of 32 bits

OURS = frozenset({"SYSID_THISMAV", "MAV_SYSID"})
"""Parameters that only the harness may set. A user must not set them."""

_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}", re.ASCII)
_COMMENTS = re.compile(r"#.*|//.*")


class ParameterError(VehicleError):
    """An error: a parameter, or a file of parameters, is invalid."""


def read(path: Path) -> dict[str, float]:
    """Return the parameters in a file, except those in `OURS`.

    If a parameter is repeated, the last value is used. Raises VehicleError.
    """
    values: dict[str, float] = {}
    for number, line in enumerate(text_of(path, MAX_BYTES).splitlines(), start=1):
        words = _COMMENTS.sub("", line).replace(",", " ").split()
        if not words:
            continue
        if len(words) == 5 and words[0].isdecimal() and words[1].isdecimal():  # system, component, name, value, type
            words = words[2:4]
        name, value = words[0], _number(words[1]) if len(words) > 1 else None
        if value is None or not _NAME.fullmatch(name):
            shown = line.strip()[:MAX_LINE_SHOWN]
            raise ParameterError(f"{path}, line {number}: {shown!r} is not a parameter: write NAME VALUE")
        values[name] = value
        if len(values) > MAX_PARAMETERS:
            raise ParameterError(f"{path} has more than {MAX_PARAMETERS} parameters")
    return {name: value for name, value in values.items() if name not in OURS}


def check(values: Mapping[str, float]) -> None:
    """Raise ParameterError for an invalid name or value, and for parameters in `OURS`."""
    if len(values) > MAX_PARAMETERS:
        raise ParameterError(f"there are more than {MAX_PARAMETERS} parameters")
    for name, value in values.items():
        if not _NAME.fullmatch(name):
            raise ParameterError(
                f"{name[:MAX_LINE_SHOWN]!r} is not the name of a parameter: use a name such as WPNAV_SPEED"
            )
        if name in OURS:
            raise ParameterError(f"{name} is the system ID, which the harness gives every vehicle: leave it out")
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise ParameterError(f"{name} is {value}: a parameter is a finite number of 32 bits")


def unknown(asked: Iterable[str], known: Iterable[str]) -> str | None:
    """Return a phrase about requested parameters that a vehicle does not have. The phrase suggests a parameter of the
    vehicle with a similar name. Return None if the vehicle has all requested parameters.
    """
    names = set(known)
    missing = sorted(set(asked) - names)
    if not missing:
        return None
    more = f" (nor {len(missing) - 1} more)" if len(missing) > 1 else ""
    nearest = get_close_matches(missing[0], names, n=1)
    meant = f"did you mean {nearest[0]}?" if nearest else "its whole list is in its directory"
    return f"no parameter {missing[0]}{more}: {meant}"


def in_lines(values: Mapping[str, float]) -> str:
    """Return the text of a parameter file, sorted by name. `read` restores each value exactly."""
    return "".join(f"{name} {shortest(values[name])}\n" for name in sorted(values))


def shortest(value: float) -> str:
    """Return the shortest decimal number that gives the same 32-bit float."""
    if not math.isfinite(value):
        return str(value)
    exact = struct.pack("<f", value)
    for digits in (6, 7, 8):
        text = f"{value:.{digits}g}"
        if struct.pack("<f", float(text)) == exact:
            return text
    return f"{value:.9g}"


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) <= LARGEST else None
