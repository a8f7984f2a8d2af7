"""The programs that tests run inside vehicles. They are started by their path, and need no packages.

    air.py listen            record each frame that arrives on eth0, by AF_PACKET
    air.py frames DESTINATION_MAC,... ETHERTYPE...   send one frame of each
    air.py stream ETHERTYPE...   broadcast a frame of each with the time, every few milliseconds until SIGTERM
    air.py serve PORT        serve a greeting over TCP

and `receive` and `broadcast` of `netem._probe`. `listen` prints "ready", and on SIGTERM its frames as one JSON object.
Times are nanoseconds of the real-time clock, which every process of a kernel shares.
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
import time

from netem._probe import broadcast, collect, print_json, receive

_STREAM_PAUSE_S = 0.005


def listen() -> None:
    source = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
    source.bind(("eth0", 0))
    counts: dict[str, dict[str, int]] = {}
    times: dict[str, dict[str, list[tuple[int, int]]]] = {}
    for frame, came_ns in collect(source, 64):
        sender, kind = frame[6:12].hex(":"), frame[12:14].hex()
        counts.setdefault(sender, {})[kind] = counts.get(sender, {}).get(kind, 0) + 1
        sent_ns = struct.unpack_from("!Q", frame, 14)[0]
        times.setdefault(sender, {}).setdefault(kind, []).append((sent_ns, came_ns))
    print_json({"frames": counts, "times_ns": times})


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
    print_json("ready")
    while not ended:
        for kind in kinds:
            out.send(addresses + bytes.fromhex(kind) + struct.pack("!Q", time.time_ns()) + bytes(38))
        time.sleep(_STREAM_PAUSE_S)


def serve(port: str) -> None:
    server = socket.create_server(("127.0.0.1", int(port)))
    print_json("ready")
    while True:
        client, _ = server.accept()
        client.sendall(b"hello")
        client.close()


if __name__ == "__main__":
    programs = {f.__name__: f for f in (listen, receive, broadcast, frames, stream, serve)}
    programs[sys.argv[1]](*sys.argv[2:])
