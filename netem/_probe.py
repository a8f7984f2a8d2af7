"""Packets on the air, sent and received from inside vehicles: standard library only, one file, started by its path.

    _probe.py receive PORT      every UDP datagram that arrives on a port, until SIGTERM
    _probe.py broadcast PORT COUNT FIRST BROADCAST_ADDRESS [BYTES [PAUSE_S]]

`broadcast` numbers its datagrams from FIRST on, writes into each when it was sent, and pauses after every 20; in the
end it says by how many seconds each pause was too long. `receive` says "ready", and on SIGTERM what it got: each one
JSON object. Times are those of the real-time clock, which every process of a kernel shares; those of arrival are the
kernel's own (SO_TIMESTAMPNS, socket(7)).
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import sys
import time
from pathlib import Path

_BURST = 20
_PAUSE_S = 0.002
_QUIET_S = 0.3
_LOOK_EVERY_S = 0.01
_LAST = 19  # nice(2)
_SO_RCVBUFFORCE = 33  # socket(7)
_SO_TIMESTAMPNS = 35
_SO_MEMINFO = 55
_BUFFER = 4 << 20  # bytes, enough for seconds: one CPU may run the sender first
_DATAGRAM = struct.Struct("!IQ")  # its number, and when it was sent, in ns
_STAMP = struct.Struct("@ll")
_MEMORY = struct.Struct("=2I")  # of a receive buffer: used, and how much there is, in bytes (sock_diag(7))


def say(what: object) -> None:
    """One line of JSON on standard output."""
    sys.stdout.write(f"{json.dumps(what)}\n")
    sys.stdout.flush()


def collect(source: socket.socket, size: int) -> list[tuple[bytes, int]]:
    """All that arrives until SIGTERM, and after it until the air is quiet; each with its time of arrival in ns.

    It leaves what arrives in the socket's buffer as long as there is room, and lets everybody else go first: what it
    takes of the processor would hold up the packets that it is there to see.
    """
    os.nice(_LAST)
    source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    asked, wake = socket.socketpair()
    signal.signal(signal.SIGTERM, lambda *_: wake.send(b"x"))
    say("ready")
    packets: list[tuple[bytes, int]] = []
    while not select.select([asked], [], [], _LOOK_EVERY_S)[0]:
        if _filled(source) > 0.25:
            packets += _drain(source, size)
    while True:
        rest = _drain(source, size)
        packets += rest
        if not rest and not select.select([source], [], [], _QUIET_S)[0]:
            return packets


def _filled(source: socket.socket) -> float:
    """The share of a socket's receive buffer that is in use."""
    used, room = map(int, _MEMORY.unpack_from(source.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 64)))
    return used / room


def _drain(source: socket.socket, size: int) -> list[tuple[bytes, int]]:
    packets = []
    with contextlib.suppress(BlockingIOError):
        while True:
            data, ((_, _, stamp),), _, _ = source.recvmsg(size, 64, socket.MSG_DONTWAIT)
            seconds, nanoseconds = _STAMP.unpack(stamp)
            packets.append((data, seconds * 1_000_000_000 + nanoseconds))
    return packets


def receive(port: str) -> None:
    source = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        source.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER)
    except PermissionError:  # for the machine's own root only; another has what net.core.rmem_max gives
        source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    source.bind(("", int(port)))
    packets = [(*_DATAGRAM.unpack_from(data), at_ns) for data, at_ns in collect(source, 2048)]
    lines = [line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")]
    counters = dict(zip(*lines, strict=True))
    say(
        {
            "numbers": [number for number, _, _ in packets],
            "delays_s": [(at_ns - sent_ns) / 1e9 for _, sent_ns, at_ns in packets],
            "at_s": [at_ns / 1e9 for _, _, at_ns in packets],
            "overflow": int(counters["RcvbufErrors"]) + int(counters["MemErrors"]),
            "corrupt": int(counters["InCsumErrors"]),
        }
    )


def broadcast(port: str, count: str, first: str, address: str, size: str = "12", pause_s: str = f"{_PAUSE_S}") -> None:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    late_s = []
    for number in range(int(first), int(first) + int(count)):
        out.sendto(_DATAGRAM.pack(number, time.time_ns()).ljust(int(size), b"\0"), (address, int(port)))
        if number % _BURST == 0:  # receivers' buffers are small, and they say so if they overflow
            before_s = time.perf_counter()
            time.sleep(float(pause_s))
            late_s.append(time.perf_counter() - before_s - float(pause_s))
    say({"late_s": late_s})


if __name__ == "__main__":
    programs = {program.__name__: program for program in (receive, broadcast)}
    programs[sys.argv[1]](*sys.argv[2:])
