"""Measure how late this machine wakes up programs, and how long each agent waits for a processor.

The harness runs this program during a mission. It writes JSON lines to the file in its first argument, and ends when
its standard input ends. `harness.archive.run_journals` describes a line.

A timer of an agent expires late for two reasons:

- The machine wakes the process of the agent late. This program sleeps for short times, and measures how late it wakes.
- The process is busy, or waits for a processor. The kernel counts the running and the waiting time of each process
  (/proc/PID/schedstat), and the time in which programs waited for a disk (/proc/pressure/io).

The kernel provides these values for agents in any language. An agent can change them only by using processor time. The
program imports only the standard library, so that it starts fast.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import TextIO

BEAT_S = 0.02
"""Seconds of wall time between two measurements of this machine."""
SLICE_MISSION_S = 2.0
"""Mission seconds that one output line covers. A line covers at least `MIN_SLICE_S` and at most `MAX_SLICE_S` seconds
of wall time.
"""
MIN_SLICE_S = 0.1
MAX_SLICE_S = 1.0
MOST_COMPUTING = 2.0
"""Maximum processor time that this program needs to write a line, as a multiple of the shortest such time so far. A
virtual machine and User Mode Linux do not know when their host stops them. They count this time as processor time of
the program that was running.
"""
NANOSECONDS = 1e9
MICROSECONDS = 1e6
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class KernelCounters:
    """Counters of the kernel. Each method returns the increase of its counter since the previous call, in seconds of
    wall time.
    """

    def __init__(self, networks: dict[int, str]) -> None:
        """Create the counters. `networks` maps the inode number of a network namespace to the agent in it."""
        self._networks = {f"net:[{inode}]": agent for inode, agent in networks.items()}
        self._agent_of: dict[str, str | None] = {}
        self._busy: dict[str, dict[str, int]] = {}
        self._stalled = self._read_stalled()

    def busy(self) -> dict[str, float]:
        """Return, for each agent, the seconds in which its processes ran or waited for a processor since the previous
        call.
        """
        present = [entry.name for entry in os.scandir("/proc") if entry.name.isdigit()]
        self._agent_of = {pid: self._agent_of[pid] if pid in self._agent_of else self._agent(pid) for pid in present}
        before, self._busy = self._busy, {}
        busy: dict[str, float] = {}
        for pid, agent in self._agent_of.items():
            if agent is None:
                continue
            try:
                threads = {entry.name: _busy_ns(entry.path) for entry in os.scandir(f"/proc/{pid}/task")}
            except OSError:
                continue  # the process has ended
            self._busy[pid] = threads
            known = before.get(pid, {})
            grown = sum(ns - known.get(thread, 0) for thread, ns in threads.items())
            busy[agent] = busy.get(agent, 0.0) + grown / NANOSECONDS
        return busy

    def stalled(self) -> float:
        """Return the seconds since the previous call in which this machine ran no program, because of a disk or a
        hypervisor.
        """
        before, self._stalled = self._stalled, self._read_stalled()
        return sum(self._stalled) - sum(before)

    def _agent(self, pid: str) -> str | None:
        try:
            return self._networks.get(str(Path("/proc", pid, "ns/net").readlink()))
        except OSError:
            return None

    def _read_stalled(self) -> tuple[float, float]:
        try:
            some = Path("/proc/pressure/io").read_text(encoding="ascii").split("\n", 1)[0]
            disk_s = int(some.rpartition("total=")[2]) / MICROSECONDS * (os.cpu_count() or 1)
        except (OSError, ValueError):
            disk_s = 0.0
        fields = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
        return disk_s, int(fields[8]) / _TICKS_PER_S


def _busy_ns(thread: str) -> int:
    ran, waited, _ = Path(thread, "schedstat").read_text(encoding="ascii").split()
    return int(ran) + int(waited)


def measure(file: TextIO, started: float, speedup: float, counters: KernelCounters, ended: threading.Event) -> None:
    """Measure the machine's delays until `ended` is set, and write a line for each interval. `started` is the time of
    mission second 0 on the monotonic clock.
    """
    slice_s = min(MAX_SLICE_S, max(MIN_SLICE_S, SLICE_MISSION_S / speedup))
    began = awake = time.monotonic()
    late = 0.0
    computed = time.thread_time()
    counters.busy()
    shortest = time.thread_time() - computed
    ending = False
    while not ending:
        ending = ended.is_set()
        time.sleep(BEAT_S)
        before, awake = awake, time.monotonic()
        late = max(late, awake - before - BEAT_S)
        if awake - began < slice_s and not ending:
            continue
        computed = time.thread_time()
        line = {
            "from_s": round((began - started) * speedup, 3),
            "until_s": round((awake - started) * speedup, 3),
            "machine_s": round(late + counters.stalled(), 4),
            "busy_s": {agent: round(seconds, 4) for agent, seconds in counters.busy().items()},
        }
        file.write(json.dumps(line, separators=(",", ":")) + "\n")
        file.flush()
        began, late = awake, 0.0
        # The machine can also stop this program while it reads the counters. Only its own computing is no delay.
        computing = time.thread_time() - computed
        shortest = min(shortest, computing)
        awake += min(computing, MOST_COMPUTING * shortest)


def main(path: str) -> None:
    request = json.loads(sys.stdin.readline())
    started = time.monotonic() - (time.time() - request["epoch_us"] / MICROSECONDS)
    counters = KernelCounters({int(inode): agent for inode, agent in request["networks"].items()})
    with Path(path).open("a", encoding="ascii") as file:
        ended = threading.Event()
        measuring = threading.Thread(target=measure, args=(file, started, request["speedup"], counters, ended))
        measuring.start()
        sys.stdin.read()
        ended.set()
        measuring.join()


if __name__ == "__main__":
    main(sys.argv[1])
