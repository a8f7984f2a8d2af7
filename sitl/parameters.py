"""ArduPilot's parameters as files have them: `NAME VALUE` or `NAME,VALUE` in each line, or QGroundControl's columns.

Read from whoever wrote them, so bounded; written as any ground station reads them.
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
LARGEST = 3.4028235e38  # of 32 bits

OURS = frozenset({"SYSID_THISMAV", "MAV_SYSID"})
"""Those that the harness sets itself, and nobody else may."""

_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}", re.ASCII)
_COMMENTS = re.compile(r"#.*|//.*")


class ParameterError(VehicleError):
    """A parameter, or a file of them, that no vehicle can be given."""


def read(path: Path) -> dict[str, float]:
    """The parameters of a file but for `OURS`; what is there twice has its last value. Raises VehicleError."""
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
            raise ParameterError(f"{path}, line {number}: {shown!r} is no parameter: write NAME VALUE")
        values[name] = value
        if len(values) > MAX_PARAMETERS:
            raise ParameterError(f"{path} has more than {MAX_PARAMETERS} parameters")
    return {name: value for name, value in values.items() if name not in OURS}


def check(values: Mapping[str, float]) -> None:
    """Raises ParameterError for a name or a value that no parameter can have, and for those of `OURS`."""
    if len(values) > MAX_PARAMETERS:
        raise ParameterError(f"there are more than {MAX_PARAMETERS} parameters")
    for name, value in values.items():
        if not _NAME.fullmatch(name):
            raise ParameterError(f"{name[:MAX_LINE_SHOWN]!r} is no parameter: names are like WPNAV_SPEED")
        if name in OURS:
            raise ParameterError(f"{name} is the system ID, which the harness gives every vehicle: leave it out")
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise ParameterError(f"{name} is {value}: a parameter is a finite number of 32 bits")


def unknown(asked: Iterable[str], known: Iterable[str]) -> str | None:
    """A phrase that names those asked for that a vehicle does not know, with the nearest that it does; None: none."""
    names = set(known)
    missing = sorted(set(asked) - names)
    if not missing:
        return None
    more = f" (nor {len(missing) - 1} more)" if len(missing) > 1 else ""
    nearest = get_close_matches(missing[0], names, n=1)
    meant = f"did you mean {nearest[0]}?" if nearest else "its whole list is in its directory"
    return f"no parameter {missing[0]}{more}: {meant}"


def in_lines(values: Mapping[str, float]) -> str:
    """The text of a parameter file, by name; what `read` makes of it is the same to the last bit of a float."""
    return "".join(f"{name} {shortest(values[name])}\n" for name in sorted(values))


def shortest(value: float) -> str:
    """The fewest digits that give the same 32-bit float."""
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
