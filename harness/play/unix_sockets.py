"""Use Unix sockets whose paths are longer than the kernel allows in an address."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def short_name(path: Path) -> Iterator[str]:
    """Provide a short name for a directory inside the context, because the address of a Unix socket has at most 107
    bytes.
    """
    descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def bind_path(outside: socket.socket, path: Path) -> None:
    """Bind a Unix socket to a path of any length. Raises OSError."""
    with short_name(path.parent) as directory:
        outside.bind(f"{directory}/{path.name}")


def connect_path(inside: socket.socket, path: Path) -> None:
    """Connect a Unix socket to a path of any length. Raises OSError."""
    with short_name(path.parent) as directory:
        inside.connect(f"{directory}/{path.name}")
