"""Runs the tests of the lab inside User Mode Linux, a kernel that has netem: `python -m tests.netem.uml`.

linux.uml (Debian: user-mode-linux) is a Linux kernel that runs as an ordinary process. It boots here on
the host's own files, so that the same tests run in the same virtual environment, and needs no rights.
Arguments go to pytest. The exit status is pytest's; a kernel that does not boot, hangs or panics is a
failure, never a pass.
"""

from __future__ import annotations

import os
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
MODULES = Path("/usr/lib/uml/modules")
DEADLINE_S = float(os.environ.get("UCP_UML_DEADLINE_S", "720"))
MEMORY = "768M"

# Without test_leftovers.py, which finds processes by their environment: this kernel does not show it.
# What ends the lab is not netem's, and is tested on the host.
_FILES = ("engine", "links", "lab", "machine")
_TESTS = ["-q", "-k", "not nftables", *(f"tests/netem/test_{name}.py" for name in _FILES)]

_SCRIPT = """#!/bin/sh
export PATH=/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8
mount -t proc proc /proc
mount -t sysfs sysfs /sys
# The host's files stay as they are: sockets and files of the tests are this kernel's own.
mount -t tmpfs tmpfs /run
mkdir -m 1777 /run/tmp && mkdir -p /run/modules/lib && ln -s {modules} /run/modules/lib/modules
export HOME=/run/tmp TMPDIR=/run/tmp
modprobe -d /run/modules -a bridge veth sch_netem sch_htb sch_ingress cls_basic cls_fw act_skbedit act_gact af_packet
modprobe -d /run/modules -q -a nf_tables nft_numgen
ip link set lo up
cd {repository}
export PYTHONDONTWRITEBYTECODE=1 UCP_TEST_PACKETS=${{UCP_TEST_PACKETS:-1500}} UCP_REQUIRE=lab,netem
{python} -m pytest -p no:cacheprovider -p no:xdist {arguments}
echo "{marker}$?"
sync
poweroff -f
"""


def main(arguments: list[str]) -> int:
    """Boot, run, and return pytest's exit status, or 1 if it never came to an end."""
    kernel = shutil.which("linux.uml")
    if kernel is None or not MODULES.is_dir():
        sys.stderr.write("User Mode Linux is not installed (Debian: apt install user-mode-linux kmod).\n")
        return 1
    marker = f"uml-{secrets.token_hex(8)}:"
    with tempfile.TemporaryDirectory(prefix="uml-") as folder:
        script = Path(folder, "init.sh")
        script.write_text(
            _SCRIPT.format(
                modules=MODULES,
                repository=shlex.quote(str(REPOSITORY)),
                python=shlex.quote(sys.executable),
                arguments=shlex.join(arguments or _TESTS),
                marker=marker,
            )
        )
        script.chmod(0o755)
        return _boot([kernel, *_options(script, Path(folder))], marker)


def _options(script: Path, folder: Path) -> list[str]:
    return [
        f"mem={MEMORY}", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"init={script}",
        f"uml_dir={folder}", "con=null", "con0=null,fd:1", "con1=null", "quiet", "panic=-1",
    ]  # fmt: skip


def _boot(command: list[str], marker: str) -> int:
    status = 1
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, errors="replace", start_new_session=True
    ) as process:
        assert process.stdout is not None
        # Its threads are processes of the host: all of them are in its session, and end together.
        signal.signal(signal.SIGALRM, lambda *_: os.killpg(process.pid, signal.SIGKILL))
        signal.setitimer(signal.ITIMER_REAL, DEADLINE_S)
        try:
            for line in process.stdout:
                if line.startswith(marker):
                    status = int(line.removeprefix(marker))
                else:
                    sys.stdout.write(line)
                    sys.stdout.flush()
            process.wait()
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    if process.returncode == -signal.SIGKILL:
        sys.stderr.write(f"User Mode Linux was killed after {DEADLINE_S:g} s; the tests count as failed.\n")
        return 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
