"""Keep the memory of a process with keys out of core dumps."""

import ctypes
import resource

_PR_SET_DUMPABLE = 4


def forbid_core_dumps() -> None:
    """Let the kernel write no core dump of this process, neither to a file nor to a program, and deny access to its
    memory to other programs of the user.

    Programs that the process starts can write only empty core dumps.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CORE)
    resource.setrlimit(resource.RLIMIT_CORE, (0, hard))
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0)
