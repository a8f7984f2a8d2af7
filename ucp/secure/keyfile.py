"""Files that hold keys: JSON, bounded, refused if others can read what is secret, written whole or not at all.

What a file says about a key is never shown: an error names the place, and what is allowed there.
"""

import contextlib
import json
import os
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

MAX_FILE_BYTES = 8 * 1024 * 1024
"""The public keys of the largest roster take 5 MiB."""
OTHERS = 0o077
SECRET_MODE, PUBLIC_MODE = 0o600, 0o644

T = TypeVar("T")


class KeyFileError(Exception):
    """A file with keys that cannot be used: one sentence with the file, and with nothing secret."""


def read_key_file(path: Path, schema: str, parse: Callable[[dict[str, Any]], T], *, secret: bool) -> T:
    """What `parse` makes of the JSON object of this schema in a file.

    Raises KeyFileError; also if it is `secret`, and others can read it.
    """
    return read_any_key_file(path, {schema: (secret, parse)})


def read_any_key_file(path: Path, kinds: Mapping[str, tuple[bool, Callable[[dict[str, Any]], T]]]) -> T:
    """As `read_key_file` does, of whichever schema the file is: for each whether it is secret, and how it is parsed."""
    try:
        document, mode = _read(path)
        schema = document.get("schema")
        if not isinstance(schema, str) or schema not in kinds:
            raise KeyFileError(f"not a file of the schema {' or '.join(kinds)}")
        secret, parse = kinds[schema]
        if secret and mode & OTHERS:
            raise KeyFileError(
                "other users can read this secret: run chmod 600, or make new keys if they may have read it"
            )
        return parse(document)
    except KeyFileError as error:
        raise KeyFileError(f"{path}: {error}") from None


def _read(path: Path) -> tuple[dict[str, Any], int]:
    """The JSON object in a file, and the file's mode. Raises KeyFileError, without the file's name."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            mode = os.fstat(descriptor).st_mode
            data = file.read(MAX_FILE_BYTES + 1) if stat.S_ISREG(mode) else None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "that is no path"
        raise KeyFileError(f"cannot be read: {reason}") from None
    if data is None:
        raise KeyFileError("not a key file")
    if len(data) > MAX_FILE_BYTES:
        raise KeyFileError(f"larger than {MAX_FILE_BYTES} bytes, the limit for key files")
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        raise KeyFileError("not JSON") from None  # what is there instead may be a key
    if not isinstance(document, dict):
        raise KeyFileError("not a key file")
    return document, mode


def write_key_file(path: Path, document: Mapping[str, Any], *, secret: bool) -> None:
    """Write a file in the place of an older one, so that there is all of the one or all of the other.

    What is `secret` nobody else can read, not for a moment. Raises OSError.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    mode = SECRET_MODE if secret else PUBLIC_MODE
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if secret:
                os.fchmod(descriptor, mode)
            file.write(json.dumps(document, indent=1).encode("ascii") + b"\n")
            file.flush()
            os.fsync(descriptor)
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise


def key_in(document: Mapping[str, Any], name: str, length: int, within: str = "") -> bytes:
    """A key, of `length` bytes in hexadecimal. Raises KeyFileError, which does not show it."""
    text = document.get(name)
    if isinstance(text, str) and len(text) == 2 * length and text.isascii():
        with contextlib.suppress(ValueError):
            key = bytes.fromhex(text)
            if len(key) == length:  # there may be spaces in it
                return key
    raise KeyFileError(f"`{within}{name}` must be {2 * length} hexadecimal digits")
