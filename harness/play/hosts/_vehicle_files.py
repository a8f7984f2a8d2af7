"""Convert between the paths of files that a vehicle program wrote, and the names with which a worker sends these files
to the lab.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

FILE_HEADER = struct.Struct("!H")
"""The format of the length of a file name, in bytes. In a message, the length comes first, then the name, then a part
of the file.
"""


def file_names(directory: Path) -> Iterator[str]:
    """Yield the names of the regular files in a directory and its subdirectories, relative to the directory."""
    for folder, _, names in os.walk(directory):
        for name in sorted(names):
            path = Path(folder, name)
            if path.is_file() and not path.is_symlink():
                yield path.relative_to(directory).as_posix()


def file_path(directory: Path, name: str) -> Path:
    """Return the path of a file, and create its subdirectory. Raises ValueError if the file is not in `directory`."""
    parts = PurePosixPath(name).parts
    if not parts or "\0" in name or any(part in ("/", "..") for part in parts):
        raise ValueError(f"{name!r} is not the name of a file")
    path = directory.joinpath(*parts)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
