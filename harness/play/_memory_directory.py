"""Keep secrets in a directory in memory. The directory is removed even if this process is killed.

A file in `/tmp` may reach a disk, and stays after SIGKILL. The directory is therefore in `/dev/shm`. A guard process
reads a pipe whose other end only this process holds. When this process ends, the kernel closes the pipe, and the guard
removes the directory.
"""

import os
import resource
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MEMORY = Path("/dev/shm")  # noqa: S108  (the directory in it has a random name, and is closed to other users)
_GUARD = 'trap "" HUP INT QUIT TERM; read _; rm -rf -- "$1"'


@contextmanager
def memory_directory(prefix: str) -> Iterator[Path]:
    """Create a directory in memory for the context, and remove it at the end. Raises OSError.

    Without `/dev/shm`, it is in the directory for temporary files.
    """
    memory = str(_MEMORY) if os.access(_MEMORY, os.W_OK) else None
    directory = tempfile.mkdtemp(prefix=prefix, dir=memory)
    guard = subprocess.Popen(
        ["/bin/sh", "-c", _GUARD, "guard", directory], stdin=subprocess.PIPE, cwd="/", env={}, start_new_session=True
    )
    try:
        yield Path(directory)
    finally:
        guard.communicate()


@contextmanager
def no_core_files() -> Iterator[None]:
    """Prevent core files inside the context, for this process and for the programs that it starts."""
    before = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_CORE, before)
