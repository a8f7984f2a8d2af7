"""Start and control the program of one vehicle on a worker. This process is the first process of the vehicle's network.

The end of this process ends each process that the vehicle started. `harness.play.hosts._vehicle_host` sends requests
through a socket, as JSON objects in one packet each. The first request starts the program. Later requests send a signal
to the program, or open a TCP connection inside the network. The answers to the first request and to requests for a
connection have the key `error`, which is null or an error number. The last message has the exit status of the program.
"""

from __future__ import annotations

import errno
import json
import os
import select
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

from harness.play._child_processes import passed_on

MAX_REQUEST_BYTES = 1 << 16


def keep(host: socket.socket) -> None:
    """Start the program that the first request names, and return when the program or the host has ended."""
    if not (data := host.recv(MAX_REQUEST_BYTES)):
        return
    order = json.loads(data)
    try:
        with Path(order["output"]).open("ab") as output:
            program = subprocess.Popen(
                order["argv"],
                cwd=order["cwd"],
                env=passed_on(os.environ),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
    except OSError as error:
        _answer(host, {"error": error.errno})
        return
    _answer(host, {"error": None})
    ended = os.pidfd_open(program.pid)
    while True:
        ready, _, _ = select.select([host.fileno(), ended], [], [])
        if ended in ready:
            _answer(host, {"status": program.wait()})
            return
        if not (data := host.recv(MAX_REQUEST_BYTES)):
            return
        request = json.loads(data)
        if "signal" in request:
            with suppress(ProcessLookupError):
                os.killpg(program.pid, request["signal"])
        else:
            _connect(host, request["port"], request["timeout_s"])


def _connect(host: socket.socket, port: int, timeout_s: float) -> None:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout_s) as connection:
            _answer(host, {"error": None}, connection.fileno())
    except OSError as error:
        _answer(host, {"error": error.errno or errno.ETIMEDOUT})


def _answer(host: socket.socket, answer: dict[str, Any], *descriptors: int) -> None:
    with suppress(OSError):  # the host has ended
        socket.send_fds(host, [json.dumps(answer).encode()], descriptors)
