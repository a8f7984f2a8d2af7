"""Read and write files with keys.

A key file is JSON of limited size. A secret file that other users can read is rejected. A file is written completely or
not at all. Error messages never show the value of a key. They name the key's place in the file and the permitted
format.
"""

import contextlib
import json
import os
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

MAX_FILE_BYTES = 8 * 1024 * 1024
"""Maximum size of a key file. The public keys of the largest roster take 5 MiB."""
OTHER_USERS = 0o077
"""Permission bits of other users and groups."""
SECRET_MODE, PUBLIC_MODE = 0o600, 0o644

T = TypeVar("T")


class KeyFileError(Exception):
    """An unusable key file. The message is one sentence with the file's name and without secrets."""


def read_key_file(path: Path, schema: str, parse: Callable[[dict[str, Any]], T], *, secret: bool) -> T:
    """Read a key file with this schema, and return its JSON object as parsed by `parse`.

    Raises KeyFileError, for example if the file is `secret` and other users can read it.
    """
    return read_any_key_file(path, {schema: (secret, parse)})


def read_any_key_file(path: Path, kinds: Mapping[str, tuple[bool, Callable[[dict[str, Any]], T]]]) -> T:
    """Read a key file that has one of several schemas. `kinds` maps each schema to (is secret, parser).

    Raises KeyFileError like `read_key_file`.
    """
    try:
        document, mode = _read(path)
        schema = document.get("schema")
        if not isinstance(schema, str) or schema not in kinds:
            raise KeyFileError(f"not a file of the schema {' or '.join(kinds)}")
        secret, parse = kinds[schema]
        if secret and mode & OTHER_USERS:
            raise KeyFileError(
                "other users can read this secret: run chmod 600, or make new keys if they may have read it"
            )
        return parse(document)
    except KeyFileError as error:
        raise KeyFileError(f"{path}: {error}") from None


def _read(path: Path) -> tuple[dict[str, Any], int]:
    """Return the JSON object in a file, and the file's mode. Raises KeyFileError without the file's name."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            mode = os.fstat(descriptor).st_mode
            data = file.read(MAX_FILE_BYTES + 1) if stat.S_ISREG(mode) else None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "the path is not valid"
        raise KeyFileError(f"cannot be read: {reason}") from None
    if data is None:
        raise KeyFileError("not a key file")
    if len(data) > MAX_FILE_BYTES:
        raise KeyFileError(f"larger than {MAX_FILE_BYTES} bytes, the limit for key files")
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        raise KeyFileError("not JSON") from None  # the parser's message may quote a key
    if not isinstance(document, dict):
        raise KeyFileError("not a key file")
    return document, mode


def write_key_file(path: Path, document: Mapping[str, Any], *, secret: bool) -> None:
    """Write a key file and replace an older one atomically. A reader sees the complete old or the complete new file.

    A `secret` file is never readable for other users. Raises OSError.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    mode = SECRET_MODE if secret else PUBLIC_MODE
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if secret:
                os.fchmod(descriptor, mode)
            file.write(json.dumps(document, indent=1).encode("ascii") + b"\n")
            file.flush()
            os.fsync(descriptor)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def key_in(document: Mapping[str, Any], name: str, length: int, within: str = "") -> bytes:
    """Return the key under `name`: `length` bytes in hexadecimal. Raises KeyFileError, which does not show the key.

    `within` is the path to `document` for the error message, for example `vehicles.`.
    """
    text = document.get(name)
    if isinstance(text, str) and len(text) == 2 * length and text.isascii():
        with contextlib.suppress(ValueError):
            key = bytes.fromhex(text)
            if len(key) == length:  # bytes.fromhex skips spaces
                return key
    raise KeyFileError(f"`{within}{name}` must be {2 * length} hexadecimal digits")
