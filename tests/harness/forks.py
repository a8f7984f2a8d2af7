"""`ucp-harness` called hundreds of times: forks of one process in which all commands are imported.

Each call is a process of its own, with arguments, working directory, environment and standard streams of its own; what
is not done anew each time is the import of the same modules, 0.4 s of processor time.
`python -m tests.harness.forks FD` is the process that forks, until nobody holds the other end of that socket.
"""

import atexit
import functools
import gc
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
MAX_REQUEST_BYTES = 1 << 17
READ_AT_START = ("PYTHON", "LANG", "LC_")
"""So begin the names of what an interpreter reads from its environment when it starts: a fork does not."""


def suits(environ: Mapping[str, str]) -> bool:
    """Whether an interpreter that starts with this environment is as ours."""
    names = {name for name in (*environ, *os.environ) if name.startswith(READ_AT_START)}
    return all(environ.get(name) == os.environ.get(name) for name in names)


def call(
    arguments: list[str], environ: Mapping[str, str], cwd: Path, typed: str, deadline_s: float
) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, and until nobody holds its standard output and error any more."""
    (stdin, keyboard), (out, stdout), (err, stderr) = os.pipe(), os.pipe(), os.pipe()
    with os.fdopen(keyboard, "w") as stream:
        stream.write(typed)
    request = json.dumps({"arguments": arguments, "environ": dict(environ), "cwd": str(cwd)})
    server = _server()
    server.settimeout(deadline_s)
    socket.send_fds(server, [request.encode()], [stdin, stdout, stderr])
    for end in (stdin, stdout, stderr):
        os.close(end)
    pid = int(server.recv(32))
    said, complained = _Text(out), _Text(err)
    try:
        for text in (said, complained):
            text.join(deadline_s)
            if text.is_alive():
                raise TimeoutError
        status = int(server.recv(32))
    except TimeoutError:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        _server.cache_clear()  # what it has to say of this one is for nobody
        raise subprocess.TimeoutExpired(arguments, deadline_s) from None
    return subprocess.CompletedProcess(arguments, status, said.text, complained.text)


class _Text(threading.Thread):
    """All that comes out of a pipe."""

    def __init__(self, end: int) -> None:
        super().__init__(daemon=True)
        self.end = end
        self.start()

    def run(self) -> None:
        with os.fdopen(self.end) as stream:
            self.text = stream.read()


@functools.cache
def _server() -> socket.socket:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(its.fileno())],
        cwd=REPOSITORY,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=[its.fileno()],
    )
    its.close()
    atexit.register(process.wait)
    atexit.register(ours.close)
    return ours


class _Ending:
    """What a fork does last: to tidy up memory that was never its own takes longer than most commands."""

    status = 1  # an exception's

    def __call__(self) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(self.status)


def _serve(channel: socket.socket) -> None:
    ending = _Ending()
    atexit.register(ending)  # before all others, so it is called after them
    from harness.cli import COMMANDS

    for command in COMMANDS.values():
        import_module(command.where.partition(":")[0])
    del sys.modules["harness.cli"]  # it runs as __main__, as with `python -m`
    gc.freeze()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        request, ends, _, _ = socket.recv_fds(channel, MAX_REQUEST_BYTES, 3)
        if not request:
            sys.exit()
        if (pid := os.fork()) == 0:
            break
        for end in ends:
            os.close(end)
        channel.send(str(pid).encode())
        _, status = os.waitpid(pid, 0)
        channel.send(str(os.waitstatus_to_exitcode(status)).encode())
    channel.close()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for standard, end in enumerate(ends):
        os.dup2(end, standard)
        os.close(end)
    try:
        _become(**json.loads(request))
    except SystemExit as end:
        assert isinstance(end.code, int), end.code
        ending.status = end.code
        raise


def _become(arguments: list[str], environ: dict[str, str], cwd: str) -> None:
    for number, (name, mode) in enumerate({"stdin": "r", "stdout": "w", "stderr": "w"}.items()):
        was = getattr(sys, name)
        buffering = 1 if was.line_buffering else -1
        setattr(sys, name, open(number, mode, buffering, was.encoding, was.errors, closefd=False))  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(cwd)
    sys.argv = ["ucp-harness", *arguments]
    sys.path[0] = cwd
    runpy.run_module("harness.cli", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
