"""Send and receive test packets inside a vehicle. This file needs only the standard library, and is started by its
path.

    _probe.py receive PORT      receive the UDP datagrams of a port until SIGTERM
    _probe.py broadcast PORT COUNT FIRST BROADCAST_ADDRESS [BYTES [PAUSE_S]]

`broadcast` numbers its datagrams from FIRST, writes the sending time into each datagram, and pauses after every 20
datagrams. At the end, it prints how many seconds each pause was too long. `receive` prints "ready", and its results on
SIGTERM. Each output is one JSON object. Times are those of the real-time clock, which all processes of a kernel share.
Arrival times come from the kernel (SO_TIMESTAMPNS, socket(7)).
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
_POLL_S = 0.01
_LOWEST_PRIORITY = 19  # nice(2)
_SO_RCVBUFFORCE = 33  # socket(7)
_SO_TIMESTAMPNS = 35
_SO_MEMINFO = 55
_BUFFER = 4 << 20  # bytes, enough for seconds, because a single CPU may run the sender first
_DATAGRAM = struct.Struct("!IQ")  # number, and sending time in ns
_STAMP = struct.Struct("@ll")
_MEMORY = struct.Struct("=2I")  # receive buffer: used and available bytes (sock_diag(7))


def print_json(what: object) -> None:
    """Print an object as one line of JSON."""
    sys.stdout.write(f"{json.dumps(what)}\n")
    sys.stdout.flush()


def collect(source: socket.socket, size: int) -> list[tuple[bytes, int]]:
    """Receive packets until SIGTERM arrives, and then until no packet has arrived for a short time. Return each packet
    with its time of arrival in nanoseconds.

    The process has the lowest priority, and leaves packets in the socket's buffer as long as the buffer has room.
    Otherwise the process would use processor time and delay the packets that it measures.
    """
    os.nice(_LOWEST_PRIORITY)
    source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    stop_pipe, wake = socket.socketpair()
    signal.signal(signal.SIGTERM, lambda *_: wake.send(b"x"))
    print_json("ready")
    packets: list[tuple[bytes, int]] = []
    while not select.select([stop_pipe], [], [], _POLL_S)[0]:
        if _filled(source) > 0.25:
            packets += _drain(source, size)
    while True:
        rest = _drain(source, size)
        packets += rest
        if not rest and not select.select([source], [], [], _QUIET_S)[0]:
            return packets


def _filled(source: socket.socket) -> float:
    """Return the used share of a socket's receive buffer, from 0 to 1."""
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
    except PermissionError:  # only root outside of user namespaces may exceed net.core.rmem_max
        source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    source.bind(("", int(port)))
    packets = [(*_DATAGRAM.unpack_from(data), at_ns) for data, at_ns in collect(source, 2048)]
    lines = [line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")]
    counters = dict(zip(*lines, strict=True))
    print_json(
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
        if number % _BURST == 0:  # receivers have small buffers, and report overflows
            before_s = time.perf_counter()
            time.sleep(float(pause_s))
            late_s.append(time.perf_counter() - before_s - float(pause_s))
    print_json({"late_s": late_s})


if __name__ == "__main__":
    programs = {program.__name__: program for program in (receive, broadcast)}
    programs[sys.argv[1]](*sys.argv[2:])
