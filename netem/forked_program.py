"""Run a function in a forked copy of this process, instead of a program in a new interpreter. A new interpreter spends
most of its start on imports. A fork shares the modules that this process has imported. A large swarm therefore starts
in a fraction of the time, and needs less memory.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable, Mapping


def fork_program(
    main: Callable[[], int | None],
    *,
    cwd: str,
    env: Mapping[str, str],
    files: tuple[int, int],
    prepare: Callable[[], None] | None = None,
) -> int:
    """Call `main` in a new process, and return the ID of this process.

    The new process has its own session, the default signal handlers and an empty standard input. `files` are its
    standard output and standard error. No other files are open in the new process. The new process calls `prepare`
    before `main`. The calling process must have one thread.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        end_with(lambda: _play(main, cwd, env, files, prepare))
    return pid


def limit_files(most_bytes: int) -> None:
    """Limit the size of the files that this process writes. The process ignores the signal SIGXFSZ, so a write beyond
    the limit fails with EFBIG.
    """
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)


def end_with(main: Callable[[], int | None]) -> None:
    """Call a function in a forked process. Then end the process in the same way as an interpreter ends."""
    status = 1
    try:
        gc.freeze()  # objects of the parent process must not close files of this one
        status = main() or 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _play(
    main: Callable[[], int | None],
    cwd: str,
    env: Mapping[str, str],
    files: tuple[int, int],
    prepare: Callable[[], None] | None,
) -> int | None:
    os.setsid()
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for descriptor, file in enumerate((nothing, *files)):
        os.dup2(file, descriptor)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    if prepare is not None:
        prepare()
    return main()
