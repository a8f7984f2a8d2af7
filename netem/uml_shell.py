"""Run a program in a virtual machine of User Mode Linux that another process has started (`netem.uml`).

    for folder in uml_shell.guests():
        status = uml_shell.enter(folder, ["ip", "address"], cwd=Path.cwd(), env=os.environ)

The virtual machine (guest) has a console for this module. The module writes input into a named pipe in the guest's
folder, and reads the console's output from a growing file there. The guest reads the name of a script from the console,
and runs this script from its folder with the console as terminal. A zero byte and the name mark the start of the
output. A zero byte, the name and the exit status mark its end. Only one program can run at a time.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import math
import os
import re
import secrets
import select
import shlex
import shutil
import sys
import termios
import time
import tty
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from netem.errors import UmlError
from netem.uml import CTRL_C, POLL_S, SHELLS_KEYS, SHELLS_SCREEN

READ_BYTES = 4096
RETRY_S = 2.0
"""Seconds between repeated requests. A guest that is booting has no console yet, and loses earlier input."""
END_MARK_BYTES = 32
_LOCK = "shell"

_SCRIPT = r"""
stty {modes}
dd if=/dev/tty of=/dev/null iflag=nonblock 2>/dev/null  # what it was asked for twice
printf '\000{token}\n'
cd {cwd} || exit
exec env --default-signal=INT,QUIT -i {environment} {argv}
"""


def guests(proc: Path = Path("/proc")) -> list[Path]:
    """Return the folders of the running virtual machines that this user may enter."""
    folders: set[Path] = set()
    for cmdline in proc.glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = cmdline.read_bytes().split(b"\0")
            folders |= {Path(os.fsdecode(word[8:])) for word in words if word.startswith(b"uml_dir=")}
    return sorted(folder for folder in folders if os.access(folder / SHELLS_KEYS, os.W_OK))


def enter(folder: Path, argv: Sequence[str], *, cwd: Path, env: Mapping[str, str]) -> int:
    """Run a program, connected to this terminal, in the virtual machine. Return its exit status. Raises UmlError if the
    program cannot be run.
    """
    try:
        with (folder / _LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return _at_console(folder, argv, cwd, env)
    except BlockingIOError:
        raise UmlError(
            "another shell is open in that User Mode Linux, which allows one at a time: close it first"
        ) from None
    except OSError as error:
        if folder.exists():
            raise UmlError(f"User Mode Linux cannot be entered: {error.strerror}") from None
        raise UmlError("User Mode Linux has ended") from None


def _at_console(folder: Path, argv: Sequence[str], cwd: Path, env: Mapping[str, str]) -> int:
    token = secrets.token_hex(8)
    (folder / token).write_text(_script(token, argv, cwd, env))
    keys = os.open(folder / SHELLS_KEYS, os.O_WRONLY | os.O_NONBLOCK)
    try:
        with (folder / SHELLS_SCREEN).open("rb", buffering=0) as screen, _raw_terminal():
            screen.seek(0, os.SEEK_END)
            return _copy_until_end(folder, token.encode(), keys, screen)
    finally:
        os.close(keys)


def _script(token: str, argv: Sequence[str], cwd: Path, env: Mapping[str, str]) -> str:
    columns, rows = shutil.get_terminal_size()
    modes, kind = "-echo -opost", {"TERM": "dumb"}
    if sys.stdin.isatty():
        modes, kind = f"sane rows {rows} cols {columns}", {}
    variables = {**env, "TMPDIR": "/run/tmp", **kind}
    environment = shlex.join(f"{name}={value}" for name, value in variables.items())
    return _SCRIPT.format(
        modes=modes, token=token, cwd=shlex.quote(str(cwd)), environment=environment, argv=shlex.join(argv)
    )


def _copy_until_end(folder: Path, token: bytes, keys: int, screen: io.FileIO) -> int:
    """Copy input to the virtual machine, and copy the output of the program, which begins after the start mark and ends
    at the end mark. Return the exit status of the program.
    """
    output, started = b"", False
    typing = sys.stdin.isatty()
    requested_at = -math.inf
    while True:
        try:
            if not started and time.monotonic() - requested_at > RETRY_S:
                os.write(keys, token + b"\n")
                requested_at = time.monotonic()
            if select.select([0] if typing and started else [], [], [], POLL_S)[0]:
                typed = os.read(0, READ_BYTES)
                typing = bool(typed)
                os.write(keys, typed)
            output += screen.readall()
        except KeyboardInterrupt:
            os.write(keys, CTRL_C)
            continue
        if not started and (start := re.search(rb"\x00%b\r?\n" % token, output)):
            output, started = output[start.end() :], True
        ended = re.search(rb"\x00%b (\d+)\r?\n" % token, output)
        if started:
            end = ended.start() if ended else _certain_length(output)
            sys.stdout.buffer.write(output[:end])
            sys.stdout.buffer.flush()
            output = output[end:]
        if ended:
            return int(ended[1])
        if not folder.exists():
            raise UmlError("User Mode Linux has ended")


def _certain_length(output: bytes) -> int:
    """Return the number of bytes at the beginning of `output` that certainly belong to the output of the program. The
    bytes after them may be a part of the end mark.
    """
    at = output.rfind(b"\0", -END_MARK_BYTES)
    return at if at >= 0 else len(output)


@contextlib.contextmanager
def _raw_terminal() -> Iterator[None]:
    """Return a context manager. Inside its context, all keys of the terminal go to the virtual machine, including
    Ctrl-C.
    """
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(0)
    try:
        tty.setraw(0)
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)
