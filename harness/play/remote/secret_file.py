"""Create and read the secret that a harness shares with the computers that join its labs.

The file has 64 hexadecimal digits, and only its owner can read it.
"""

import os
import secrets
from pathlib import Path

from harness.errors import HarnessError, MachineError
from ucp.plain_file import open_plain_file

_SECRET_BYTES = 32
_OTHER_USERS = 0o077


class SecretError(HarnessError):
    """An error: a secret file cannot be used."""


def create_secret(path: Path) -> None:
    """Create a file with a new secret. Raises SecretError if the file exists, and MachineError if the file cannot be
    written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise SecretError(f"{path} exists: choose another name, because secrets are never replaced") from None
    except OSError as error:
        raise MachineError(f"{path} cannot be created: {error.strerror}; choose another place") from None
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(f"{secrets.token_hex(_SECRET_BYTES)}\n")


def read_secret(path: Path) -> bytes:
    """Return the secret in a file. Raises SecretError, whose message names a solution."""
    make = f"make one with `ucp-harness join --new-secret {path}`"
    try:
        with open_plain_file(path) as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(2 * _SECRET_BYTES + 2).decode("ascii").strip()
    except OSError as error:
        raise SecretError(f"the secret file {path} cannot be read: {error.strerror}; {make}") from None
    except UnicodeDecodeError:
        text, mode = "", 0
    if mode & _OTHER_USERS:
        raise SecretError(f"other users can read the secret file {path}: run chmod 600 {path}")
    try:
        secret = bytes.fromhex(text)
    except ValueError:
        secret = b""
    if len(secret) != _SECRET_BYTES:
        raise SecretError(f"{path} does not have the {2 * _SECRET_BYTES} hexadecimal digits of a secret: {make}")
    return secret
