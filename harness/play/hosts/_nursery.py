"""Fork the programs of agents and vehicles on a worker from one process that has imported them.

A new interpreter for each agent would spend most of the start on imports. The nursery has one thread and no event loop,
so it can be forked safely. It ends with the process that started it, and its children end with it.

Each vehicle has one network for the whole run, as in a lab. All incarnations of its agent and of its program enter this
network. An agent therefore reaches its vehicle at the same address as in a lab.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from harness.play.hosts import _vehicle_keeper
from harness.play.remote import far_worker
from harness.play.remote._forked_process import ForkedProcess
from netem import far_network
from netem.forked_program import end_with
from ucp import node

MAX_ORDER_BYTES = 1 << 16
OWN_AGENT = [sys.executable, "-P", "-m", "ucp.node"]
"""The command of the harness's own agent. The nursery runs this agent in a forked process. It starts every other agent
as a separate program.
"""

MAVLINK = "pymavlink.dialects.v20.common"
"""A module that the agents of vehicles need. Its import needs half a second of processor time, so the nursery imports
it once for all agents.
"""


class Nursery:
    """A process that forks a new process for each agent and each vehicle. Create it before an event loop runs in this
    process.
    """

    def __init__(self, *, user_namespace: bool) -> None:
        self.networks: dict[int, int] = {}
        """Vehicle -> inode number of its network namespace, as in /proc/PID/ns/net."""
        self._requests, other_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if os.fork() == 0:
            self._requests.close()
            end_with(partial(_serve, other_end, user_namespace))
        other_end.close()

    async def start_agent(
        self, vehicle: int, inside: socket.socket, directory: Path, command: Sequence[str]
    ) -> ForkedProcess:
        """Start `harness.play.remote.far_worker` in the network of a vehicle. `inside` is the socket with which the
        started program communicates with this process.
        """
        return self._start(vehicle, inside, [str(directory), *command])

    def start_vehicle(self, vehicle: int, inside: socket.socket) -> ForkedProcess:
        """Start `harness.play.hosts._vehicle_keeper` in the network of a vehicle. `inside` is the socket with which the
        started program communicates with this process.
        """
        return self._start(vehicle, inside, None)

    def _start(self, vehicle: int, inside: socket.socket, agent: list[str] | None) -> ForkedProcess:
        order = json.dumps({"vehicle": vehicle, "agent": agent}).encode()
        socket.send_fds(self._requests, [order], [inside.fileno()])
        data, descriptors, _, _ = socket.recv_fds(self._requests, MAX_ORDER_BYTES, 1)
        pid, self.networks[vehicle] = json.loads(data)
        return ForkedProcess(pid, descriptors[0])


def _serve(requests: socket.socket, user_namespace: bool) -> None:
    far_network.become_keeper(user_namespace=user_namespace)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(os.open(os.devnull, os.O_RDWR), 0)  # the input of the parent shows that its worker lives
    networks: dict[int, int] = {}
    while True:
        data, descriptors, _, _ = socket.recv_fds(requests, MAX_ORDER_BYTES, 1)
        if not data:
            return
        order = json.loads(data)
        if order["agent"] is None:
            import_module(MAVLINK)
        if order["vehicle"] not in networks:
            networks[order["vehicle"]] = far_network.create_network()
        network = networks[order["vehicle"]]
        _remove_ended_children()
        pid = os.fork()
        if pid == 0:
            requests.close()
            end_with(partial(_play, descriptors[0], order, network))
        os.close(descriptors[0])
        descriptor = os.pidfd_open(pid)
        socket.send_fds(requests, [json.dumps([pid, os.fstat(network).st_ino]).encode()], [descriptor])
        os.close(descriptor)


def _remove_ended_children() -> None:
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def _play(inside: int, order: dict[str, Any], network: int) -> None:
    """Run one incarnation of an agent or of a vehicle program, as the first process in the vehicle's network."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    far_network.become_first_process(network)
    if order["agent"] is None:
        _vehicle_keeper.keep(socket.socket(fileno=inside))
        return
    directory, *command = order["agent"]
    far_worker.play(inside, Path(directory), command, node.main if command == OWN_AGENT else None)
