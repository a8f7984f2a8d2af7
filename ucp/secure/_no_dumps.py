"""Prevent core dumps of a process that has keys, because a core dump would contain the keys."""

import ctypes
import resource

_PR_SET_DUMPABLE = 4


def forbid_core_dumps() -> None:
    """Prevent core dumps of this process to a file or to a program. Also prevent other programs of the user from
    accessing the memory of this process.

    Programs that the process starts can write only empty core dumps.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, hard))
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0)
