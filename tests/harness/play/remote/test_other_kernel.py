"""Test a run whose remote agent has another kernel and another clock: those of User Mode Linux, connected by a TAP
interface.
"""

import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.play.remote.secret_file import create_secret
from netem import _uml_registers, uml
from tests.harness.command import COMMAND
from tests.harness.play.remote.test_remote_runs import GOOD, play, scenario, verdicts
from tests.harness.two_computers import OUR_AGENT, TwoComputers, needs_two_computers
from tests.machine import require_uml

pytestmark = [pytest.mark.lab, pytest.mark.uml, *needs_two_computers]

LISTEN = "192.168.8.1:14700"
REPOSITORY = Path(__file__).parents[4]

GUEST = """#!/bin/sh
export PATH={path} PYTHONPATH={sources} TMPDIR=/run/tmp
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
mkdir -p /dev/shm /dev/net /run/tmp /run/modules/lib
mount -t tmpfs tmpfs /dev/shm
ln -s /proc/self/fd /dev/fd
ln -s {modules} /run/modules/lib/modules
modprobe -d /run/modules -a tun veth bridge af_packet
[ -e /dev/net/tun ] || mknod /dev/net/tun c 10 200
ip link set lo up
ip address add 192.168.8.2/24 dev vec0
ip link set vec0 up
cd {directory}
until {join}; do sleep 0.1; done
halt -f
"""


@pytest.fixture
def computers(tmp_path: Path) -> Iterator[TwoComputers]:
    """Yield two computers. The harness runs on the first computer. A guest joins through the TAP interface of this
    computer.
    """
    require_uml()
    create_secret(tmp_path / "lab.key")
    with TwoComputers(tmp_path) as both:
        both.on("lab", "ip", "tuntap", "add", "tap0", "mode", "tap")
        both.on("lab", "ip", "address", "add", "192.168.8.1/24", "dev", "tap0")
        both.on("lab", "ip", "link", "set", "tap0", "up")
        yield both


def boot(computers: TwoComputers) -> subprocess.Popen[str]:
    """Start User Mode Linux as a guest of the harness's computer. The guest joins the run with an agent. After the run,
    it halts.
    """
    kernel, directory = uml.find(), computers.directory
    join = [*COMMAND, "join", LISTEN, "--as", "2", "--secret-file", "lab.key", "--", *OUR_AGENT]
    init = directory / "init"
    init.write_text(
        GUEST.format(
            path=shlex.quote(uml.SYSTEM_PATH),
            sources=shlex.quote(str(REPOSITORY)),
            modules=uml.MODULES,
            directory=shlex.quote(str(directory)),
            join=shlex.join(join),
        )
    )
    init.chmod(0o755)
    registers = _uml_registers.preload(directory) if _uml_registers.needed(kernel) else {}
    options = ["mem=1G", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f'init="{init}"', "con=null"]
    options += [f"uml_dir={directory}", "con0=null,fd:1", "vec0:transport=tap,ifname=tap0", "quiet", "panic=-1"]
    return computers.run("lab", "env", *(f"{key}={value}" for key, value in registers.items()), str(kernel), *options)


def test_agent_on_another_kernel_is_judged_as_any_agent(computers: TwoComputers) -> None:
    path = scenario(
        computers.directory,
        duration_s=120,
        speedup=5,
        network={"loss": 0.1},
        timeline=[{"at_s": 60, "reboot": [2], "down_s": 20, "disk": "kept"}],
        remote={"agents": [2], "secret_file": "lab.key", "listen": LISTEN},
    )
    guest = boot(computers)
    record, output = play(computers, path, far=guest)
    assert (verdicts(record), record["status"]) == (GOOD, 0), output
    remote = record["remote"]["2"]
    assert (remote["host"], remote["joins"], remote["lost"]) == ("192.168.8.2", 2, 0)
    assert remote["pings"] > 0
