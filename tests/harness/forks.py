"""Call `ucp-harness` without the time for its imports. A server process that has already imported all commands forks
for each call.

Each call is a process with its own arguments, working directory, environment and standard streams. A fork needs no
import of the modules, which saves 0.4 s of processor time. `python -m tests.harness.forks FD` is the server process. It
ends when the other end of its socket is closed.
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
"""Prefixes of environment variables that an interpreter reads only at its start. A forked process would ignore changes
of them.
"""


def same_interpreter(environ: Mapping[str, str]) -> bool:
    """Return whether a new interpreter with this environment would behave like the present one."""
    names = {name for name in (*environ, *os.environ) if name.startswith(READ_AT_START)}
    return all(environ.get(name) == os.environ.get(name) for name in names)


def call(
    arguments: list[str],
    environ: Mapping[str, str],
    cwd: Path,
    typed: str,
    deadline_s: float,
    packages: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends and until all its children have closed standard output and error.

    With `packages`, the command imports from the standard library and from this directory only.
    """
    (stdin, keyboard), (out, stdout), (err, stderr) = os.pipe(), os.pipe(), os.pipe()
    with os.fdopen(keyboard, "w") as stream:
        stream.write(typed)
    request = json.dumps({"arguments": arguments, "environ": dict(environ), "cwd": str(cwd)})
    server = _server(packages)
    server.settimeout(deadline_s)
    socket.send_fds(server, [request.encode()], [stdin, stdout, stderr])
    for end in (stdin, stdout, stderr):
        os.close(end)
    pid = int(server.recv(32))
    output, errors = _PipeReader(out), _PipeReader(err)
    try:
        for text in (output, errors):
            text.join(deadline_s)
            if text.is_alive():
                raise TimeoutError
        status = int(server.recv(32))
    except TimeoutError:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        _server.cache_clear()  # the next call starts a new server, because this one would first report the killed fork
        raise subprocess.TimeoutExpired(arguments, deadline_s) from None
    return subprocess.CompletedProcess(arguments, status, output.text, errors.text)


class _PipeReader(threading.Thread):
    """A thread that reads a pipe to its end."""

    def __init__(self, end: int) -> None:
        super().__init__(daemon=True)
        self.end = end
        self.start()

    def run(self) -> None:
        with os.fdopen(self.end) as stream:
            self.text = stream.read()


@functools.cache
def _server(packages: Path | None) -> socket.socket:
    own_end, server_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    alone = ["-S", "-P"] if packages else []  # neither `site-packages` nor the working directory
    process = subprocess.Popen(
        [sys.executable, *alone, "-m", __name__, str(server_end.fileno())],
        cwd=REPOSITORY,
        env={**os.environ, **({"PYTHONPATH": str(packages)} if packages else {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=[server_end.fileno()],
    )
    server_end.close()
    atexit.register(process.wait)
    atexit.register(own_end.close)
    return own_end


class _FastExit:
    """The last exit function of a forked process. It ends the process without releasing memory, which would take
    long.
    """

    status = 1  # the status after an exception

    def __call__(self) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(self.status)


def _serve(channel: socket.socket) -> None:
    fast_exit = _FastExit()
    atexit.register(fast_exit)  # registered before all others, so it is called last
    from harness.cli import COMMANDS
    from harness.errors import MachineError

    for command in COMMANDS.values():
        with suppress(MachineError):  # an extra is missing
            import_module(command.location.partition(":")[0])
    del sys.modules["harness.cli"]  # a fork runs it as __main__, as `python -m` does
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
        _run_command(**json.loads(request))
    except SystemExit as end:
        assert isinstance(end.code, int), end.code
        fast_exit.status = end.code
        raise


def _run_command(arguments: list[str], environ: dict[str, str], cwd: str) -> None:
    for number, (name, mode) in enumerate({"stdin": "r", "stdout": "w", "stderr": "w"}.items()):
        was = getattr(sys, name)
        buffering = 1 if was.line_buffering else -1
        setattr(sys, name, open(number, mode, buffering, was.encoding, was.errors, closefd=False))  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(cwd)
    sys.argv = ["ucp-harness", *arguments]
    if not sys.flags.safe_path:
        sys.path[0] = cwd
    runpy.run_module("harness.cli", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
