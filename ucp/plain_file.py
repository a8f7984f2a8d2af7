"""Read files of unknown origin within limits of time and memory.

A file that another person or another machine made may be endless, huge, or not a regular file. A program that reads a
FIFO may wait forever. A program that reads `/dev/zero` fills its memory. Parsed JSON takes more memory than its text.
For example, the three bytes `[],` become 64 bytes. Every reader in this project therefore opens files with
`open_plain_file`, reads at most a given number of bytes, and counts the values of a JSON text before it parses the
text. The functions of this module raise OSError or ValueError with a description for the user.
"""

import contextlib
import errno
import io
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAX_JSON_WEIGHT = 250_000
"""Maximum weight of a JSON text. The weight estimates how much memory the parsed text takes. A list or an object weighs
5, and any other value 1. A value of the wrong type takes 400 bytes in a validation error, so a text of the maximum
weight takes about 100 MiB.
"""

_CHUNK_BYTES = 64 * 1024


def open_plain_file(path: Path) -> io.BufferedReader:
    """Open a regular file for reading.

    Raises OSError if the file does not exist, may not be read, or is a directory, FIFO, device or socket, or if its
    name is not valid.
    """
    # Without O_NONBLOCK, opening a FIFO would block until a process writes to it.
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError:  # NUL
        raise OSError(errno.EINVAL, "the name is not valid") from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        is_directory = stat.S_ISDIR(mode)
        raise OSError(errno.EISDIR, "is a directory") if is_directory else OSError(errno.EINVAL, "is not a file")
    return os.fdopen(descriptor, "rb")


def read_plain_file(path: Path, most_bytes: int) -> bytes:
    """Return the content of a regular file. Raises OSError, for example if the file has more than `most_bytes`."""
    with open_plain_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = bytearray()
        while size <= most_bytes and len(content) <= most_bytes and (part := file.read(_CHUNK_BYTES)):
            content += part  # a single read would allocate `most_bytes` at once
    if size > most_bytes or len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes} bytes")
    return bytes(content)


def read_text(path: Path, most_bytes: int) -> str:
    """Return the UTF-8 text of a regular file. Raises OSError, or UnicodeDecodeError."""
    return read_plain_file(path, most_bytes).decode("utf-8")


def check_weight(text: str | bytes, most: int = MAX_JSON_WEIGHT) -> None:
    """Raise ValueError if the weight of a JSON text (see MAX_JSON_WEIGHT) is above `most`. Commas and brackets inside
    strings count as well.
    """
    if isinstance(text, str):
        weight = text.count(",") + 4 * (text.count("[") + text.count("{"))
    else:
        weight = text.count(b",") + 4 * (text.count(b"[") + text.count(b"{"))
    if weight > most:
        raise ValueError("too many values")


def parse_json(text: str | bytes, *, strict: bool = True, most_weight: int = MAX_JSON_WEIGHT) -> Any:
    """Return the value of a JSON text, with limits on its nesting and its weight. Raises ValueError.

    Bytes are UTF-8; `json.loads` would also accept UTF-16. With `strict` false, strings may contain control characters.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8")
    with _limits(text, most_weight):
        return json.loads(text, strict=strict)


def parse_json_at(text: str, position: int) -> tuple[Any, int]:
    """Parse the JSON value that begins at index `position` of the text. Return the value, and the index after its end.
    Raises ValueError.
    """
    with _limits(text, MAX_JSON_WEIGHT):
        return json.JSONDecoder().raw_decode(text, position)


@contextlib.contextmanager
def _limits(text: str, most_weight: int) -> Iterator[None]:
    check_weight(text, most_weight)
    try:
        yield
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except json.JSONDecodeError:
        raise
    except ValueError:
        raise ValueError("a number of thousands of digits") from None


def json_problem(error: ValueError) -> str:
    """Return a description of an error that `parse_json` or `read_json` raised."""
    if isinstance(error, json.JSONDecodeError):
        return f"not JSON at line {error.lineno}"
    return "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else str(error)


def read_json(path: Path, most_bytes: int, most_weight: int = MAX_JSON_WEIGHT) -> Any:
    """Return the value of a JSON file within limits. Raises OSError or ValueError."""
    return parse_json(read_text(path, most_bytes), most_weight=most_weight)
