"""Create private networks for processes. The command unshare(1) starts the first process. This process then uses
setns(2) to enter the networks.

The first process is PID 1 of its own PID namespace. Its end therefore ends each process of the lab, and afterwards the
kernel removes namespaces, links and rules. Three mechanisms end the first process after the harness has ended. The
first process ends when the harness closes the control socket or dies. The kernel sends the first process a death
signal, which setpriv(1) requests. The option `--kill-child` of unshare(1) kills the first process when the unshare
process ends.
"""

from __future__ import annotations

import ctypes
import os
import pwd
import re
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

CLONE_NEWNET = 0x40000000
_CLONE_NEWNS, _CLONE_NEWUSER, _CLONE_NEWPID = 0x00020000, 0x10000000, 0x20000000
_PR_SET_PDEATHSIG = 1
_MS_NOSUID, _MS_NODEV, _MS_NOEXEC, _MS_REC, _MS_PRIVATE = 2, 4, 8, 0x4000, 0x40000

AS_ROOT = "as root"

_libc = ctypes.CDLL(None, use_errno=True)


def unshare_network() -> None:
    """Move this thread into a new network namespace. The function calls unshare(2) itself, because `os.unshare` needs
    Python 3.12.
    """
    _check(_libc.unshare(CLONE_NEWNET))


def open_network() -> int:
    """Return a file descriptor of this thread's network namespace."""
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


def enter_network(namespace: int) -> None:
    """Move this thread into a network namespace. The function calls setns(2) itself, because `os.setns` needs Python
    3.12.
    """
    _check(_libc.setns(namespace, CLONE_NEWNET))


@contextmanager
def inside(namespace: int, home: int) -> Iterator[None]:
    """Run code in the network namespace `namespace`, and then return to the namespace `home`. Both arguments are file
    descriptors.
    """
    enter_network(namespace)
    try:
        yield
    finally:
        enter_network(home)


def die_with_parent() -> None:
    """Let the kernel kill this process when the thread that started it ends."""
    _check(_libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL))


def become_root() -> None:
    """Move this process into a user namespace of its own, in which it has all rights. The process must have one
    thread.
    """
    user, group = os.geteuid(), os.getegid()
    _check(_libc.unshare(_CLONE_NEWUSER))
    for name, text in (("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1")):
        Path("/proc/self", name).write_text(text)


def become_first_process(network: int) -> None:
    """Fork, and return only in the new process. The new process is PID 1 of a new PID namespace, and uses the network
    namespace with the file descriptor `network`.

    The calling process does not return. It waits outside the PID namespace until the new process ends, as `unshare
    --kill-child` does. Each of the two processes ends when its parent ends.
    """
    enter_network(network)
    _check(_libc.unshare(_CLONE_NEWNS | _CLONE_NEWPID))
    die_with_parent()
    pid = os.fork()
    if pid:
        os.closerange(0, os.sysconf("SC_OPEN_MAX"))
        os.waitpid(pid, 0)
        os._exit(0)
    die_with_parent()
    _check(_libc.mount(b"none", b"/", None, _MS_REC | _MS_PRIVATE, None))
    _check(_libc.mount(b"proc", b"/proc", b"proc", _MS_NOSUID | _MS_NODEV | _MS_NOEXEC, None))


def _check(result: int) -> None:
    if result != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def command(argv: Sequence[str], *, user_namespace: bool, die_with_parent: bool = True) -> list[str]:
    """Return the command that runs `argv` as the first process of a private network (unshare(1)).

    If `user_namespace` is true, the caller needs no special rights, and the command has all rights over the objects
    that it creates. The death signal follows the *thread* that started the command (PR_SET_PDEATHSIG in prctl(2)). Set
    `die_with_parent` to false if this thread may end before the lab.
    """
    setpriv = ["setpriv", "--pdeathsig", "KILL"] if die_with_parent else []
    user = ["--user", "--map-root-user"] if user_namespace else []
    return [*setpriv, "unshare", *user, "--net", "--mount", "--pid", "--fork", "--kill-child",
            "--mount-proc", *argv]  # fmt: skip


def user_namespace_choices() -> tuple[bool, ...]:
    """Return the values of `user_namespace` in the order in which the caller should try them.

    Root needs no user namespace unless its rights are limited.
    """
    return (False, True) if os.geteuid() == 0 else (True,)


def probe() -> tuple[bool, str]:
    """Return whether this machine allows network namespaces. Also return a description of the namespaces, or the error
    message if this machine does not allow them.
    """
    message = ""
    for user_namespace in user_namespace_choices():
        argv = command(["true"], user_namespace=user_namespace, die_with_parent=False)
        try:
            done = subprocess.run(argv, capture_output=True, text=True, timeout=10, check=False)
        except FileNotFoundError as error:
            return False, f"{error.filename} is not installed"
        except subprocess.TimeoutExpired:
            return False, "unshare did not come back within 10 s"
        if done.returncode == 0:
            return True, "own user namespace, no root needed" if user_namespace else AS_ROOT
        message = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"status {done.returncode}"
    return False, message


def not_executed(message: str) -> tuple[str, str] | None:
    """Parse the message of unshare(1) or setpriv(1) that it could not execute a program. Return the name of the program
    and the reason. Return None for any other message.
    """
    match = re.fullmatch(r"(?:unshare|setpriv): failed to execute (.+): (.+)", message)
    return (match[1], match[2]) if match else None


def user() -> str:
    """Return the user whose rights this process has on the machine, such as "user mail". In a user namespace, root
    stands for an ordinary user of the machine. The function then returns this ordinary user.
    """
    uid = os.geteuid()
    for line in Path("/proc/self/uid_map").read_text().splitlines():
        inside, outside, count = map(int, line.split())
        if inside <= uid < inside + count:
            uid += outside - inside
            break
    try:
        return f"user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"user {uid}"


def way_out(message: str) -> str:
    """Return advice for a user whose machine cannot create namespaces. `message` is the error that the attempt to
    create namespaces gave.
    """
    if "not installed" in message:
        return "Install util-linux (Debian, Ubuntu: apt install util-linux)."
    if not_executed(message):
        return "Let that user reach it, or use a Python that every user can execute (Debian, Ubuntu: /usr/bin/python3)."
    as_root = "or run as root"
    if _sysctl("user/max_user_namespaces") == 0:
        return f"User namespaces are switched off: sudo sysctl user.max_user_namespaces=15000, {as_root}."
    if _sysctl("user/max_net_namespaces") == 0:
        return "Network namespaces are switched off: sudo sysctl user.max_net_namespaces=15000."
    if _sysctl("kernel/unprivileged_userns_clone") == 0:
        return f"This kernel keeps them for root: sudo sysctl kernel.unprivileged_userns_clone=1, {as_root}."
    if _sysctl("kernel/apparmor_restrict_unprivileged_userns") == 1:
        return (
            "AppArmor keeps them from ordinary programs (Ubuntu 24.04 and later): sudo sysctl "
            f"kernel.apparmor_restrict_unprivileged_userns=0, {as_root}."
        )
    if any(Path(mark).exists() for mark in ("/.dockerenv", "/run/.containerenv")):
        return (
            "A container runtime forbids them: start the container with --privileged, or with --cap-add "
            "SYS_ADMIN --cap-add NET_ADMIN --security-opt seccomp=unconfined --security-opt "
            "apparmor=unconfined --security-opt systempaths=unconfined."
        )
    return "Run as root, or on a kernel that allows unprivileged user namespaces."


def _sysctl(name: str) -> int | None:
    try:
        return int(Path("/proc/sys", name).read_text())
    except (OSError, ValueError):
        return None
