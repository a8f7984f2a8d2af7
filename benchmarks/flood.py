"""Flood an agent with forged datagrams: `python -m benchmarks.flood [--per-s 40000] [--seconds 5] [-- COMMAND ...]`.

A secured agent runs as a process in a lab. Another vehicle of its mission sends it 20 queries per second, and a process
on this other vehicle sends forged datagrams. The table has a row for each class of forged datagrams. A row has the
number of forged datagrams that were sent per second, the number that the agent read per second, the share of the
queries that the agent answered, and the processor time of the agent for one datagram that it read. The kernel discards
datagrams that the agent does not read in time. The share of answered queries therefore depends on the machine: the
flood, the network and the agent need two free cores. On a busy machine, `--speedup 0.1 --per-s 4000` plays the same
flood in slow motion: 40,000 datagrams arrive in a mission second.
"""

import argparse
import asyncio
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import cycle, islice
from pathlib import Path
from random import Random

from benchmarks.forgeries import make_boot
from harness.conformance._reference_model import AGENT, ROSTER
from harness.conformance._udp_lab import UdpLab
from harness.conformance.cases._bench import INCEPTION, BenchAgent, CaseBench
from harness.conformance.cases._secured_cases import ASKING_PEER, BUNDLE, SecuredPeers
from ucp.messages import ChainContainQuery, encode
from ucp.secure.bundle import KeySet, write_bundle

QUESTIONS_PER_S = 20
BURST_S = 0.005
"""Seconds between two bursts of forged datagrams."""
DISTINCT = 2000
"""Number of different forged datagrams of a class."""

Forge = Callable[[bytes, Random], bytes]
CLASSES: dict[str, Forge] = {
    "nothing": lambda good, rng: b"",
    "not secured": lambda good, rng: encode(ASKING_PEER, rng.randrange(2**32), ChainContainQuery(rng.randbytes(32))),
    "wrong tag": lambda good, rng: good[:8] + rng.randbytes(4) + good[12:],
    "unknown boot": lambda good, rng: good[:18] + make_boot(2**60, rng.randbytes(8)) + good[34:],
    "far epoch": lambda good, rng: (
        good[:8] + rng.randbytes(4) + good[12:14] + rng.randrange(2, 4000).to_bytes(4, "big") + good[18:]
    ),
    "forged revocation": lambda good, rng: good[:3] + b"\x0a" + good[4:8] + rng.randbytes(4) + good[12:],
    "replay": lambda good, rng: good,
}


def forged(name: str, good: bytes) -> list[bytes]:
    """Return forged datagrams of a class. They are made from an authentic datagram that the agent has received."""
    rng = Random(1)
    return [CLASSES[name](good, rng) for _ in range(DISTINCT)]


def flood(send: Callable[[bytes], object], datagrams: Sequence[bytes], per_s: float, seconds: float) -> int:
    """Send forged datagrams at this rate, and return their number."""
    source, began, sent, burst = cycle(datagrams), time.monotonic(), 0, round(per_s * BURST_S)
    while (passed := time.monotonic() - began) < seconds:
        if sent > passed * per_s:
            time.sleep(0.001)
            continue
        for datagram in islice(source, burst):
            with suppress(BlockingIOError):
                send(datagram)
        sent += burst
    return sent


def process_of(agent: BenchAgent) -> Path:
    """Return the directory of the agent's process in /proc. Inside the lab, the process has a different process ID."""
    mission = f"{agent.process.agent_id}.mission.json".encode()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            if any(word.endswith(mission) for word in words) and (process / "cwd").resolve() == agent.process.directory:
                return process
    raise SystemExit("the process of the agent is not visible here")


def processor_s(process: Path) -> float:
    """Return the processor seconds that a process has used so far."""
    fields = (process / "stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def dropped(agent: BenchAgent) -> int:
    """Return the number of datagrams that the agent has dropped so far."""
    return sum((await agent.status())["dropped"].values())


async def row(peers: SecuredPeers, name: str, per_s: float, seconds: float) -> str:
    """Flood the agent with forged datagrams of one class, and return the row of the table."""
    socket = peers.agent.peer_socket
    good = await peers.require_single_answer("its start")
    datagrams = forged(name, good)
    process, (read_end, write_end) = process_of(peers.agent), os.pipe()
    before_s, dropped_before = processor_s(process), await dropped(peers.agent)
    child = 0 if name == "nothing" else os.fork()
    if child == 0 and name != "nothing":
        sent = flood(socket.send, datagrams, per_s, seconds)
        os.write(write_end, str(sent).encode())
        os._exit(0)
    asked = 0
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        socket.send(peers.sealed(ASKING_PEER, ChainContainQuery(INCEPTION)))
        asked += 1
        await asyncio.sleep(1 / QUESTIONS_PER_S)
    sent = 0
    if child:
        os.waitpid(child, 0)
        sent = int(os.read(read_end, 20))
    await asyncio.sleep(1)
    socket.drain()
    answered, used_s = len(socket.take()), processor_s(process) - before_s
    read = await dropped(peers.agent) - dropped_before
    os.close(read_end), os.close(write_end)
    each = f"{used_s / read * 1e6:8.1f}" if read else f"{'':8}"
    return f"{name:20}{sent / seconds:10.0f}{read / seconds:10.0f}{answered / asked:10.0%}{each}"


async def flood_all(command: Sequence[str], per_s: float, seconds: float, speedup: float) -> None:
    """Flood a new agent with each class, and print a row for each."""
    keys = KeySet.derived(os.urandom(32), ROSTER)

    def prepare(directory: Path) -> None:
        write_bundle(directory / BUNDLE, keys.bundle(AGENT))

    mission = {"features": ["secured"], "security": {"bundle": BUNDLE}, "speedup": speedup}
    sys.stdout.write(f"{'class':20}{'sent/s':>10}{'read/s':>10}{'answered':>10}{'us each':>8}\n")
    with tempfile.TemporaryDirectory() as place:
        async with UdpLab(Path(place), command, 1) as lab:
            for name in CLASSES:
                async with CaseBench(lab).agent(mission, prepare=prepare) as agent:
                    sys.stdout.write(await row(SecuredPeers(agent, keys), name, per_s, seconds) + "\n")
                    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-s", type=float, default=40_000, help="forged datagrams per second")
    parser.add_argument("--seconds", type=float, default=5, help="duration of each flood")
    parser.add_argument("--speedup", type=float, default=1, help="mission seconds per second")
    parser.add_argument("command", nargs="*", default=[sys.executable, "-P", "-m", "ucp.node"], help="the agent")
    arguments = parser.parse_args()
    asyncio.run(flood_all(arguments.command, arguments.per_s, arguments.seconds, arguments.speedup))


if __name__ == "__main__":
    main()
