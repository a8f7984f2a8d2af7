"""Read text files that a user names. Only regular files of limited size are read."""

from __future__ import annotations

import stat
from pathlib import Path

from sitl.vehicle import VehicleError

MAX_SHOWN = 200


def text_of(path: Path, limit: int) -> str:
    """Return the text of a regular file of at most `limit` bytes. Raises VehicleError."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise VehicleError(f"{path} is not a file")
        if status.st_size > limit:
            raise VehicleError(f"{path} is larger than {limit} bytes")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise VehicleError(f"{str(path)[:MAX_SHOWN]} cannot be read: {error.strerror}") from None
    except ValueError:  # the text is not UTF-8, or the path contains NUL
        raise VehicleError(f"{str(path)[:MAX_SHOWN]!r} is not a text file") from None
