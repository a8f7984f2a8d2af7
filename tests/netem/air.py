"""The programs that tests run inside vehicles: standard library only, one file, started by its path.

    air.py listen            every frame that arrives on eth0, by AF_PACKET
    air.py receive PORT      every UDP datagram that arrives on a port
    air.py broadcast PORT COUNT FROM BROADCAST_ADDRESS [BYTES]
    air.py frames DESTINATION_MAC,... ETHERTYPE...   one frame of each
    air.py stream ETHERTYPE...   a frame of each to everyone, with the time, every few milliseconds until SIGTERM
    air.py serve PORT        a TCP server that greets

`listen` and `receive` say "ready", and on SIGTERM what they got, one JSON object. Times are nanoseconds of the real
time clock, which every process of a kernel shares; those of arrival are the kernel's own.
"""

from __future__ import annotations

import json
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
_STREAM_PAUSE_S = 0.005
_SO_RCVBUFFORCE = 33  # socket(7)
_SO_TIMESTAMPNS = 35
_WHOLE_TEST = 16 << 20  # bytes, enough for all datagrams of a test: one CPU may run the sender first


def say(what: object) -> None:
    sys.stdout.write(f"{json.dumps(what)}\n")
    sys.stdout.flush()


def collect(source: socket.socket, size: int) -> list[tuple[bytes, int]]:
    """All that arrives until SIGTERM, and after it until the air is quiet; each with its time of arrival."""
    source.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    asked, wake = socket.socketpair()
    signal.signal(signal.SIGTERM, lambda *_: wake.send(b"x"))
    say("ready")
    found: list[tuple[bytes, int]] = []
    ending = False
    while True:
        ready, _, _ = select.select([source] if ending else [source, asked], [], [], _QUIET_S if ending else None)
        if asked in ready:
            ending = True
        elif not ready:
            return found
        if source in ready:
            data, ((_, _, stamp),), _, _ = source.recvmsg(size, 64)
            seconds, nanoseconds = struct.unpack("@ll", stamp)
            found.append((data, seconds * 1_000_000_000 + nanoseconds))


def listen() -> None:
    source = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
    source.bind(("eth0", 0))
    counts: dict[str, dict[str, int]] = {}
    times: dict[str, dict[str, list[int]]] = {}
    for frame, _ in collect(source, 64):
        sender, kind = frame[6:12].hex(":"), frame[12:14].hex()
        counts.setdefault(sender, {})[kind] = counts.get(sender, {}).get(kind, 0) + 1
        times.setdefault(sender, {}).setdefault(kind, []).append(struct.unpack_from("!Q", frame, 14)[0])
    say({"frames": counts, "sent_ns": times})


def receive(port: str) -> None:
    source = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        source.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _WHOLE_TEST)
    except PermissionError:  # for the machine's own root only; another has what net.core.rmem_max gives
        source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WHOLE_TEST)
    source.bind(("", int(port)))
    found = [(*struct.unpack_from("!IQ", data), at_ns) for data, at_ns in collect(source, 2048)]
    lines = [line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")]
    counters = dict(zip(*lines, strict=True))
    say(
        {
            "numbers": [number for number, _, _ in found],
            "delays_s": [(at_ns - sent_ns) / 1e9 for _, sent_ns, at_ns in found],
            "at_s": [at_ns / 1e9 for _, _, at_ns in found],
            "overflow": int(counters["RcvbufErrors"]),
            "corrupt": int(counters["InCsumErrors"]),
        }
    )


def broadcast(port: str, count: str, first: str, address: str, size: str = "12") -> None:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    for number in range(int(first), int(first) + int(count)):
        out.sendto(struct.pack("!IQ", number, time.time_ns()).ljust(int(size), b"\0"), (address, int(port)))
        if number % _BURST == 0:
            time.sleep(_PAUSE_S)  # receivers' buffers are small, and they say so if they overflow


def frames(destinations: str, *kinds: str) -> None:
    out = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
    out.bind(("eth0", 0))
    sender = out.getsockname()[4]
    for destination in destinations.split(","):
        for kind in kinds:
            out.send(bytes.fromhex(destination.replace(":", "")) + sender + bytes.fromhex(kind) + bytes(46))


def stream(*kinds: str) -> None:
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    out = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
    out.bind(("eth0", 0))
    addresses = bytes.fromhex("ffffffffffff") + out.getsockname()[4]
    say("ready")
    while not ended:
        for kind in kinds:
            out.send(addresses + bytes.fromhex(kind) + struct.pack("!Q", time.time_ns()) + bytes(38))
        time.sleep(_STREAM_PAUSE_S)


def serve(port: str) -> None:
    server = socket.create_server(("127.0.0.1", int(port)))
    say("ready")
    while True:
        client, _ = server.accept()
        client.sendall(b"hello")
        client.close()


if __name__ == "__main__":
    programs = {f.__name__: f for f in (listen, receive, broadcast, frames, stream, serve)}
    programs[sys.argv[1]](*sys.argv[2:])
