"""Provide an embedded vehicle in its own process, and a simple client, for tests of vehicles."""

from __future__ import annotations

import contextlib
import itertools
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from pymavlink.dialects.v20 import common as mavlink

from sitl.vehicle import Home, VehicleType

HOME = Home(-35.363262, 149.165237, 584.0, 270.0)
DEADLINE_S = 20.0  # long enough for a busy machine; tests do not wait for this time


T = TypeVar("T")


def until(condition: Callable[[], T | None], what: str) -> T:
    """Wait until the value of the condition is true, and return this value."""
    deadline = time.monotonic() + DEADLINE_S
    while not (result := condition()):
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.005)
    return result


def free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [sock.getsockname()[1] for sock in sockets]


def connect(port: int) -> socket.socket:
    """Connect to a port as soon as a program listens at it."""

    def attempt() -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
        except OSError:
            return None

    return until(attempt, f"a vehicle on port {port}")


def embedded_argv(*extra: str, sysid: int = 3, home: str = str(HOME), speedup: float = 100.0) -> list[str]:
    argv = [sys.executable, "-m", "sitl.embedded", "--sysid", str(sysid), "--home", home, "--speedup", f"{speedup:g}"]
    return [*argv, *extra]


@dataclass
class Vehicle:
    """An embedded vehicle that runs, and its ports."""

    process: subprocess.Popen[bytes]
    pilot_port: int
    agent_port: int
    station_port: int


@contextlib.contextmanager
def embedded(sysid: int = 3, speedup: float = 100.0, vehicle_type: VehicleType = "copter") -> Iterator[Vehicle]:
    ports = free_ports(3)
    options = itertools.chain(*zip(("--pilot-port", "--agent-port", "--station-port"), map(str, ports), strict=True))
    process = subprocess.Popen(embedded_argv("--type", vehicle_type, *options, sysid=sysid, speedup=speedup))
    try:
        yield Vehicle(process, *ports)
    finally:
        process.kill()
        process.wait()


class Client:
    """A client that sends one request at a time."""

    def __init__(self, port: int) -> None:
        self.sock = connect(port)
        self.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.mav.robust_parsing = True
        self._waiting: list[Any] = []
        self.bytes_received = 0

    def wait_for(self, kind: str, **fields: Any) -> Any:
        """Return the next message of this type whose fields have these values."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            while self._waiting:
                message = self._waiting.pop(0)
                if message.get_type() == kind and all(getattr(message, name) == fields[name] for name in fields):
                    return message
            assert time.monotonic() < deadline, f"no {kind} with {fields}"
            data = self.sock.recv(65536)
            assert data, f"the vehicle hung up, no {kind} with {fields}"
            self.bytes_received += len(data)
            self._waiting += self.mav.parse_buffer(data) or ()

    def command(self, command: int, *params: float, target: int = 3) -> int:
        """Send a COMMAND_LONG, and return the result code (MAV_RESULT)."""
        padded = [*params, *[0.0] * (7 - len(params))]
        message = mavlink.MAVLink_command_long_message(target, 1, command, 0, *padded)
        self.sock.sendall(message.pack(self.mav))
        return int(self.wait_for("COMMAND_ACK", command=command).result)
