"""Measure a link of the lab without conditions: `python -m benchmarks.link [--rounds R] [--seconds S] [--json]`.

Each link connects two vehicles. All links exist at the same time in one private network, and each round measures all of
them. One link is a veth pair made with ip(8) (`veth`), and another one is the switch of the lab without an engine
(`switch`). For each engine that works on this machine, there is also a switch with this engine, without conditions.
Ratios are relative to the veth pair of the same round.

The figures for UDP are the number of datagrams of 512 bytes that arrive per second, while the sender sends without
pause, and the processor time to send, transport and receive a datagram. The figure for TCP is the number of bytes that
one connection receives per second. A round trip is a datagram of 64 bytes and its echo. Both ends are Python programs,
on separate processors if there are two. All figures include the time of these programs.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

from benchmarks.rounds import Spread, show
from netem import _namespaces, addresses
from netem._fabric import VirtualSwitch
from netem._nft import NftablesEngine
from netem.engine import Engine
from netem.errors import EngineError
from netem.tc import NetemEngine

_DATAGRAM = bytes(512)
_PING = bytes(64)
_CHUNK = bytes(256 << 10)
_BURST = 64  # datagrams, which a receiver has room for
_PORT = 14600
_DEADLINE_S = 10.0
_ROUND_TRIPS = 5000
_WARM_UP = 200

_fork = multiprocessing.get_context("fork")  # a socket stays in the network in which it was made, in a child too


@dataclass(frozen=True)
class Link:
    """A link between vehicles 1 and 2.

    `inside` is a function that enters the network of a vehicle (`VirtualSwitch.inside`).
    """

    name: str
    inside: Callable[[int], AbstractContextManager[None]]

    def datagrams(self) -> tuple[socket.socket, socket.socket]:
        """Return two connected UDP sockets, one in the network of each vehicle."""
        ends = []
        for vehicle, peer in ((1, 2), (2, 1)):
            with self.inside(vehicle):
                end = socket.socket(type=socket.SOCK_DGRAM)
            end.settimeout(_DEADLINE_S)
            end.bind((addresses.address(vehicle), _PORT))
            end.connect((addresses.address(peer), _PORT))
            ends.append(end)
        return ends[0], ends[1]

    def stream(self) -> tuple[socket.socket, socket.socket]:
        """Return both ends of a TCP connection from vehicle 1 to vehicle 2."""
        with self.inside(2):
            listener = socket.create_server((addresses.address(2), _PORT))
        with listener, self.inside(1):
            client = socket.create_connection(listener.getsockname(), timeout=_DEADLINE_S)
            server, _ = listener.accept()
        server.settimeout(_DEADLINE_S)
        return client, server


def veth_pair() -> Link:
    _namespaces.unshare_network()
    one = _namespaces.open_network()
    _namespaces.unshare_network()
    two = _namespaces.open_network()
    _ip(f"link add eth0 type veth peer name eth0 netns /proc/{os.getpid()}/fd/{one}", *_own(2))
    _namespaces.enter_network(one)
    _ip(*_own(1))
    ends = {1: one, 2: two}
    return Link("veth", lambda vehicle: _namespaces.inside(ends[vehicle], one))


def _own(vehicle: int) -> list[str]:
    network = f"{addresses.address(vehicle)}/{addresses.PREFIX_LENGTH}"
    return [f"address add {network} dev eth0", "link set eth0 up", "link set lo up"]


def _ip(*commands: str) -> None:
    subprocess.run(["ip", "-batch", "-"], input="\n".join(commands), text=True, check=True)


def switch(engine: type[Engine] | None) -> Link:
    """Make a switch like `netem.init`. Raises EngineError if the engine does not work."""
    _namespaces.unshare_network()
    fabric = VirtualSwitch([1, 2], {})
    if engine is not None:
        engine(fabric)
    return Link(engine.name if engine else "switch", fabric.inside)


def links() -> list[Link]:
    found = [veth_pair(), switch(None)]
    for engine in (NetemEngine, NftablesEngine):
        try:
            found.append(switch(engine))
        except EngineError as error:
            sys.stderr.write(f"Left out: engine {engine.name}, {error}\n")
    return found


# Measurements


def udp(link: Link, seconds: float) -> dict[str, float]:
    sender, receiver = link.datagrams()
    with sender, receiver, _beside(_count_datagrams, receiver) as counted:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            for _ in range(_BURST):
                sender.send(_DATAGRAM)
        for _ in range(5):  # an empty datagram ends the stream, if the buffer has room for it
            time.sleep(0.02)
            sender.send(b"")
        return {"UDP 1000 datagrams/s": counted() / 1000}


def _count_datagrams(receiver: socket.socket) -> float:
    count = 0
    receiver.recv(len(_DATAGRAM))
    start = last = time.perf_counter()
    while receiver.recv(len(_DATAGRAM)):
        count += 1
        last = time.perf_counter()
    return count / (last - start)


def udp_cost(link: Link, seconds: float) -> dict[str, float]:
    """Measure the processor time of a datagram. One process sends and receives it, so other load hardly affects the
    result.
    """
    sender, receiver = link.datagrams()
    count = 0
    with sender, receiver:
        start = time.process_time()
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            for _ in range(_BURST):
                sender.send(_DATAGRAM)
            for _ in range(_BURST):
                receiver.recv(len(_DATAGRAM))
            count += _BURST
        return {"UDP processor us": (time.process_time() - start) / count * 1e6}


def tcp(link: Link, seconds: float) -> dict[str, float]:
    sender, receiver = link.stream()
    with sender, receiver, _beside(_count_bytes, receiver) as counted:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            sender.sendall(_CHUNK)
        sender.shutdown(socket.SHUT_WR)
        return {"TCP Mbyte/s": counted() / 1e6}


def _count_bytes(receiver: socket.socket) -> float:
    buffer = bytearray(len(_CHUNK))
    count = 0
    start = time.perf_counter()
    while received := receiver.recv_into(buffer):
        count += received
    return count / (time.perf_counter() - start)


def round_trips(link: Link, _: float) -> dict[str, float]:
    near, far = link.datagrams()
    microseconds = []
    with near, far, _beside(_echo, far):
        for _ in range(_WARM_UP + _ROUND_TRIPS):
            start = time.perf_counter_ns()
            near.send(_PING)
            near.recv(len(_PING))
            microseconds.append((time.perf_counter_ns() - start) / 1000)
    percentiles = statistics.quantiles(microseconds[_WARM_UP:], n=100)
    return {"round trip median us": percentiles[49], "round trip 99 % us": percentiles[98]}


def _echo(far: socket.socket) -> float:
    while True:
        far.send(far.recv(len(_PING)))


@contextmanager
def _beside(function: Callable[[socket.socket], float], end: socket.socket) -> Iterator[Callable[[], float]]:
    """Run the function in another process during the block. Yield a function that waits for its result."""
    ours, theirs = _fork.Pipe(duplex=False)

    def run() -> None:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        theirs.send(function(end))

    def result() -> float:
        if not ours.poll(_DEADLINE_S):
            raise TimeoutError("The other end of the link did not finish")
        return float(ours.recv())

    process = _fork.Process(target=run)
    process.start()
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield result
    finally:
        os.sched_setaffinity(0, processors)
        process.kill()
        process.join()


def measure(rounds: int, seconds: float) -> dict[str, dict[str, list[float]]]:
    """Measure all links in each round. Return the figures by quantity and link."""
    found: dict[str, dict[str, list[float]]] = {}
    lines = links()
    for _ in range(rounds):
        for what in (udp, udp_cost, tcp, round_trips):
            for link in lines:
                for quantity, figure in what(link, seconds).items():
                    found.setdefault(quantity, {}).setdefault(link.name, []).append(figure)
    return found


def rows(found: dict[str, dict[str, list[float]]]) -> list[dict[str, Any]]:
    return [
        {
            "quantity": quantity,
            "link": link,
            "figure": Spread.of(figures),
            "ratio": Spread.of_ratios(figures, by_link["veth"]),
        }
        for quantity, by_link in found.items()
        for link, figures in by_link.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15, help="number of rounds")
    parser.add_argument("--seconds", type=float, default=0.2, help="duration of each measurement of a rate")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)  # in the private network already
    options = parser.parse_args()
    if options.inside:
        found = rows(measure(options.rounds, options.seconds))
        show(found, {"figure": ",.1f", "ratio": ".2f"}, options.json)
        return
    possible, message = _namespaces.probe()
    if not possible:
        sys.stderr.write(f"This machine does not allow private networks ({message}). {_namespaces.way_out(message)}\n")
        sys.exit(3)
    argv = [sys.executable, "-m", "benchmarks.link", "--inside", *sys.argv[1:]]
    sys.exit(subprocess.run(_namespaces.command(argv, user_namespace=os.geteuid() != 0), check=False).returncode)


if __name__ == "__main__":
    main()
