"""Store secrets in a directory that is in memory. The directory is removed even if this process is killed.

A file in `/tmp` may reach a disk, and stays after SIGKILL. The directory is therefore in `/dev/shm`. A guard process
reads a pipe whose other end only this process holds. When this process ends, the kernel closes the pipe, and the guard
removes the directory.

If both processes are killed, the directory stays. Each process therefore locks its directory (flock(2)), and the kernel
removes the lock at the end of the process. `remove_abandoned` removes the directories without a lock. The next run and
`ucp-harness clean` call it.
"""

import fcntl
import os
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

KEYS_PREFIX = "ucp-keys-"
"""Prefix of the directories with the keys of a run."""
_MEMORY = Path("/dev/shm")  # noqa: S108  (the directory in it has a random name, and is closed to other users)
_GUARD = 'trap "" HUP INT QUIT TERM; read _; rm -rf -- "$1"'


@contextmanager
def memory_directory(prefix: str) -> Iterator[Path]:
    """Create a directory in memory for the context, and remove it at the end. Raises OSError. If `/dev/shm` does not
    exist, the directory is in the directory for temporary files.
    """
    remove_abandoned(prefix)
    unlocked = Path(tempfile.mkdtemp(prefix=f".{prefix}", dir=_place()))
    with _locked(unlocked):
        directory = unlocked.rename(unlocked.with_name(unlocked.name[1:]))
        guard = subprocess.Popen(
            ["/bin/sh", "-c", _GUARD, "guard", str(directory)],
            stdin=subprocess.PIPE,
            cwd="/",
            env={},
            start_new_session=True,
        )
        try:
            yield directory
        finally:
            guard.communicate()


def remove_abandoned(prefix: str) -> list[Path]:
    """Remove the directories of this user with this prefix that belong to killed processes. Return the paths of these
    directories.
    """
    removed = []
    for directory in sorted(_place().glob(f"{prefix}*")):
        with suppress(OSError):  # in use, removed meanwhile, or of another user
            if directory.lstat().st_uid == os.getuid():
                with _locked(directory):
                    shutil.rmtree(directory)
                removed.append(directory)
    return removed


def _place() -> Path:
    return _MEMORY if os.access(_MEMORY, os.W_OK) else Path(tempfile.gettempdir())


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Lock a directory for the context. Raises BlockingIOError if another process has locked it."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def no_core_files() -> Iterator[None]:
    """Prevent core files inside the context, for this process and for the programs that it starts."""
    before = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_CORE, before)
