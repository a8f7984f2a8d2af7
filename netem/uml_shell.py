"""A program inside a User Mode Linux that somebody else has started (`netem.uml`), at a console of its own.

    for folder in uml_shell.guests():
        status = uml_shell.enter(folder, ["ip", "address"], cwd=Path.cwd(), env=os.environ)

What is typed goes into a named pipe of the guest's folder, and what the console shows is a file there that grows. The
guest waits at that console for the name of a script in its folder, and runs it with the console as its terminal. When
it begins a zero byte and that name are shown, and these with the exit status at its end. One program at a time.
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
ASK_AGAIN_S = 2.0
"""A guest that boots has no console yet, and is told nothing of what was typed before."""
LAST_WORD_BYTES = 32
_LOCK = "shell"

_SCRIPT = r"""
stty {modes}
dd if=/dev/tty of=/dev/null iflag=nonblock 2>/dev/null  # what it was asked for twice
printf '\000{token}\n'
cd {cwd} || exit
exec env --default-signal=INT,QUIT -i {environment} {argv}
"""


def guests(proc: Path = Path("/proc")) -> list[Path]:
    """The folders of those that run and that we may enter."""
    folders: set[Path] = set()
    for cmdline in proc.glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            words = cmdline.read_bytes().split(b"\0")
            folders |= {Path(os.fsdecode(word[8:])) for word in words if word.startswith(b"uml_dir=")}
    return sorted(folder for folder in folders if os.access(folder / SHELLS_KEYS, os.W_OK))


def enter(folder: Path, argv: Sequence[str], *, cwd: Path, env: Mapping[str, str]) -> int:
    """Run a program there with our terminal as its own; its exit status. Raises UmlError if it cannot be, or ends."""
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
            return _until_it_ends(folder, token.encode(), keys, screen)
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


def _until_it_ends(folder: Path, token: bytes, keys: int, screen: io.FileIO) -> int:
    """Carry what is typed there, and here what is shown between the two words of the console's."""
    shown, begun = b"", False
    typing = sys.stdin.isatty()
    asked_at = -math.inf
    while True:
        try:
            if not begun and time.monotonic() - asked_at > ASK_AGAIN_S:
                os.write(keys, token + b"\n")
                asked_at = time.monotonic()
            if select.select([0] if typing and begun else [], [], [], POLL_S)[0]:
                typed = os.read(0, READ_BYTES)
                typing = bool(typed)
                os.write(keys, typed)
            shown += screen.readall()
        except KeyboardInterrupt:
            os.write(keys, CTRL_C)
            continue
        if not begun and (start := re.search(rb"\x00%b\r?\n" % token, shown)):
            shown, begun = shown[start.end() :], True
        ended = re.search(rb"\x00%b (\d+)\r?\n" % token, shown)
        if begun:
            end = ended.start() if ended else _last_word_may_begin(shown)
            sys.stdout.buffer.write(shown[:end])
            sys.stdout.buffer.flush()
            shown = shown[end:]
        if ended:
            return int(ended[1])
        if not folder.exists():
            raise UmlError("User Mode Linux has ended")


def _last_word_may_begin(shown: bytes) -> int:
    """Up to where it is certain that this is no part of it."""
    at = shown.rfind(b"\0", -LAST_WORD_BYTES)
    return at if at >= 0 else len(shown)


@contextlib.contextmanager
def _raw_terminal() -> Iterator[None]:
    """Inside, each key is the guest's, Ctrl-C, too."""
    if not sys.stdin.isatty():
        yield
        return
    before = termios.tcgetattr(0)
    try:
        tty.setraw(0)
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)
