"""Run one command in User Mode Linux, a Linux kernel with netem that runs as an ordinary process.

    status = uml.run(["my-command", "--flag"], cwd=Path.cwd(), env=os.environ)

linux.uml (Debian: user-mode-linux) boots from the host's own files (hostfs). The command finds all programs and
directories at their usual paths, and writes with the caller's rights. The command needs no other rights. Inside the
guest it is root. Only the directory /run is separate from the host. TMPDIR is inside it. The guest has one processor,
and a system call takes about twenty times as long as on the host.

The output of the command is copied without delay. The terminal of the command is a console of the guest. Ctrl-C and
SIGTERM reach the command as Ctrl-C, and the command has no other input. Another console is for shells
(`netem.uml_shell`). On a further console, the guest prints an empty line every few seconds, and finally the exit status
of the command. Without this status, `run` raises an error.

Programs inside keep their floating point and vector registers, also on processors that the kernel does not support
(`netem._uml_registers`).

Nothing remains after the caller ends. The processes of User Mode Linux form one process group on the host, led by a
shell. The shell kills the group and removes its directory when the caller closes its end of a pipe or dies.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import BinaryIO

from netem import _uml_registers
from netem.errors import UmlError

MODULES = Path("/usr/lib/uml/modules")
SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
MEMORY = "2G"
"""Maximum memory of the guest. The host provides only the memory that the guest uses."""

BEAT_S = 5
SILENCE_LIMIT_S = 90.0
"""A guest counts as hung if it prints nothing for this number of seconds. A guest boots within a few seconds, and then
prints regularly.
"""

POLL_S = 0.05
SHELLS_KEYS, SHELLS_SCREEN = "keys", "screen"
"""Names of two files in a guest's folder: the input and the output of the console for shells (`netem.uml_shell`)."""
INTERRUPTED = 128 + signal.SIGINT
CTRL_C = b"\x03"

_GUARD = """
{ read -r _ <"/proc/self/fd/$UML_CALLER"; rm -rf "$UML_FOLDER"; kill -KILL 0; } &
exec "$@"
"""

_INIT = r"""#!/bin/sh
export PATH={path}
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
mkdir -p /dev/shm && mount -t tmpfs tmpfs /dev/shm
ln -s /proc/self/fd /dev/fd
mkdir -m 1777 /run/tmp && mkdir -p /run/modules/lib && ln -s {modules} /run/modules/lib/modules
modprobe -d /run/modules -a bridge veth sch_netem sch_htb sch_ingress cls_basic cls_fw act_skbedit act_gact af_packet
modprobe -d /run/modules -q -a nf_tables nft_numgen
ip link set lo up
set -e
exec 3</dev/tty1  # kept open, it keeps its size
stty -F /dev/tty1 -echo -opost {size}
stty -F /dev/tty2 -opost
stty -F /dev/tty3 -opost
# Where the caller's output is not a terminal, the command's is a pipe; not to its terminal, which ends with it.
carriers=
carry() {{ mkfifo "/run/$1"; cat "/run/$1" >"/dev/$1" & carriers="$carriers $!"; }}
{carried}
set +e
# What `netem.uml_shell` asks for, each with a terminal of its own; it is asked for until it has begun.
mkdir -p /dev/pts && mount -t devpts devpts /dev/pts
while stty -echo && read -r asked; do
  mv "{folder}/$asked" "{folder}/$asked.begun" || continue
  script -qefc "sh {folder}/$asked.begun" /dev/null
  printf '\000%s %s\n' "$asked" "$?"
done 0<>/dev/tty5 1>&0 2>/dev/null &
setsid --ctty --wait sh {command} </dev/tty1 >{stdout} 2>{stderr}
status=$?
for carrier in $carriers; do wait "$carrier"; done
sync
echo "$status" >/dev/tty4
exec sleep infinity
"""

_COMMAND = """
trap : INT QUIT
while echo; do sleep {beat_s}; done >/dev/tty4 2>&1 &
cd {cwd} || exit
env -i {environment} {argv}
"""


def inside() -> bool:
    """Return true if this process runs in User Mode Linux."""
    return "User Mode Linux" in Path("/proc/cpuinfo").read_text()


def find() -> Path:
    """Return the path of the kernel. Raises UmlError with the names of missing packages."""
    kernel = shutil.which("linux.uml")
    path = os.pathsep.join([os.environ.get("PATH", ""), SYSTEM_PATH])
    packages = {
        "user-mode-linux": kernel is not None and MODULES.is_dir(),
        "kmod": shutil.which("modprobe", path=path),
        "iproute2": shutil.which("ip", path=path),
        "gcc": _uml_registers.has_compiler() or not _uml_registers.needed(Path(kernel) if kernel else None),
    }
    missing = [package for package, here in packages.items() if not here]
    if kernel is None or missing:
        problem = "User Mode Linux is not installed" if kernel is None else "User Mode Linux lacks a requirement here"
        raise UmlError(f"{problem} (Debian, Ubuntu: apt install {' '.join(missing)})")
    return Path(kernel).absolute()


def examine() -> str:
    """Boot User Mode Linux as a test. Return a text with the path of the kernel and the method by which it preserves
    registers. Raises UmlError.
    """
    kernel = find()
    status = run(["true"], cwd=Path("/"), env={"PATH": SYSTEM_PATH})
    if status != 0:
        raise UmlError(f"User Mode Linux failed: it boots, but `true` ends in it with status {status}")
    how = "kept by a library that is preloaded" if _uml_registers.needed(kernel) else "kept by itself"
    return f"{kernel}, in which this processor's registers are {how}"


def run(argv: Sequence[str], *, cwd: Path, env: Mapping[str, str]) -> int:
    """Run a command in its own kernel. Return its exit status. If a signal killed the command, the status is 128 plus
    the number of the signal.

    `env` is the environment of the command, except for TMPDIR. If `run` is called in the main thread, Ctrl-C and
    SIGTERM go to the command. Before the guest has booted, these signals end the guest, and the status is 130. Raises
    UmlError if User Mode Linux is missing, does not boot, hangs or panics.
    """
    kernel = find()
    with tempfile.TemporaryDirectory(prefix="uml-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "command").write_text(_command(argv, cwd, env))
        (folder / "init").write_text(_init(folder / "command"))
        (folder / "init").chmod(0o755)
        guest = _RunningKernel(kernel, folder, _uml_registers.preload(folder) if _uml_registers.needed(kernel) else {})
        try:
            with _forwarding_interrupts(guest):
                return guest.follow()
        except KeyboardInterrupt:
            return INTERRUPTED
        finally:
            guest.end()


def _command(argv: Sequence[str], cwd: Path, env: Mapping[str, str]) -> str:
    variables = {**env, "TMPDIR": "/run/tmp"}
    return _COMMAND.format(
        beat_s=BEAT_S,
        cwd=shlex.quote(str(cwd)),
        environment=shlex.join(f"{name}={value}" for name, value in variables.items()),
        argv=shlex.join(argv),
    )


def _init(command: Path) -> str:
    stdout = "/dev/tty1" if sys.stdout.isatty() else "/run/tty2"
    stderr = "/dev/tty3" if sys.stderr.isatty() else "/run/tty3"
    columns, rows = shutil.get_terminal_size()
    return _INIT.format(
        path=SYSTEM_PATH,
        modules=MODULES,
        size=f"rows {rows} columns {columns}",
        carried="\n".join(f"carry {Path(path).name}" for path in (stdout, stderr) if path.startswith("/run")),
        command=shlex.quote(str(command)),
        folder=command.parent,
        stdout=stdout,
        stderr=stderr,
    )


class _RunningKernel:
    """A running User Mode Linux. The caller must call `end`. The consoles of the kernel write to files in `folder`, and
    this class reads the files while they grow. Pipes are unsuitable, because a console drops output if its pipe is
    full.
    """

    def __init__(self, kernel: Path, folder: Path, preload: Mapping[str, str]) -> None:
        self.up = False
        self._folder = folder
        keyboard_input, self._keyboard = os.pipe()
        caller, self._lifeline = os.pipe()
        with contextlib.ExitStack() as stack:
            kernel_log, terminal, stdout, stderr, word, screen = (
                stack.enter_context((folder / name).open("ab")).fileno()
                for name in ("kernel", "stdout", "stdout", "stderr", "word", SHELLS_SCREEN)
            )
            os.mkfifo(folder / SHELLS_KEYS, 0o600)
            keys = stack.enter_context((folder / SHELLS_KEYS).open("r+b", buffering=0)).fileno()
            options = [
                f"mem={MEMORY}", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw",
                f'init="{folder / "init"}"', f"uml_dir={folder}", "con=null", "con0=null,fd:1",
                f"con1=fd:{keyboard_input},fd:{terminal}", f"con2=null,fd:{stdout}", f"con3=null,fd:{stderr}",
                f"con4=null,fd:{word}", f"con5=fd:{keys},fd:{screen}", "quiet", "selinux=0", "panic=-1",
            ]  # fmt: skip
            self._process = subprocess.Popen(
                ["sh", "-c", _GUARD, "sh", str(kernel), *options],
                stdin=subprocess.DEVNULL,
                stdout=kernel_log,
                stderr=kernel_log,
                cwd=folder,
                env={**os.environ, **preload, "UML_CALLER": str(caller), "UML_FOLDER": str(folder)},
                pass_fds=(keyboard_input, terminal, stdout, stderr, word, keys, screen, caller),
                start_new_session=True,
            )
        os.close(keyboard_input)
        os.close(caller)

    def type(self, keys: bytes) -> None:
        os.write(self._keyboard, keys)

    def follow(self) -> int:
        """Copy the output of the command until it ends, and return its exit status. Raises UmlError."""
        with contextlib.ExitStack() as stack:
            stdout, stderr, word = (
                stack.enter_context((self._folder / name).open("rb", buffering=0))
                for name in ("stdout", "stderr", "word")
            )
            received = b""
            last_output_s = time.monotonic()
            while True:
                ended = self._process.poll() is not None
                chunk = word.read()
                received += chunk
                printed, errors = stdout.read(), stderr.read()
                # The command's output can precede the first empty line, and the caller may react to it immediately.
                self.up = self.up or bool(received or printed or errors)
                _write(sys.stdout.buffer, printed)
                _write(sys.stderr.buffer, errors)
                if chunk or printed or errors:
                    last_output_s = time.monotonic()
                elif (status := _exit_status(received)) is not None:
                    return status
                elif ended:
                    raise self._failed("it ended" if self.up else "it did not boot")
                elif time.monotonic() > last_output_s + SILENCE_LIMIT_S:
                    raise self._failed(f"it printed nothing for {SILENCE_LIMIT_S:g} s")
                else:
                    time.sleep(POLL_S)

    def _failed(self, problem: str) -> UmlError:
        lines = (self._folder / "kernel").read_text(errors="replace").splitlines()
        printed = [line.strip() for line in lines if line.strip()] or ["nothing"]
        last = next((line for line in printed if "LD_PRELOAD" in line or "panic" in line), printed[-1])
        return UmlError(f"User Mode Linux failed: {problem}; its last output is: {last}")

    def end(self) -> None:
        """Kill the virtual machine of User Mode Linux, if it still runs."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._keyboard)
        os.close(self._lifeline)


def _write(target: BinaryIO, data: bytes) -> None:
    if data:
        target.write(data)
        target.flush()


def _exit_status(received: bytes) -> int | None:
    """Return the exit status from the received text. Return None if the text does not yet contain the complete line
    with the status.
    """
    *lines, _ = received.split(b"\n")
    return next((int(line) for line in lines if line.strip()), None)


@contextlib.contextmanager
def _forwarding_interrupts(guest: _RunningKernel) -> Iterator[None]:
    """Forward Ctrl-C and SIGTERM to the virtual machine: each of them arrives there as a typed Ctrl-C. This works only
    in the main thread.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not guest.up:
            raise KeyboardInterrupt
        guest.type(CTRL_C)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
