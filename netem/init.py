"""The first process inside the virtual network. It builds the network, and then executes requests of the harness.

The harness starts it as `python -m netem.init FD` inside new namespaces (see `netem._namespaces`), where it is PID 1.
`FD` is its end of the control socket. The process has one thread, because setns(2) moves a thread to another network,
and each child must start in the right network. Its loop never blocks on one task: it opens TCP connections in the
background, and reports the end of a child when it happens.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from errno import EINPROGRESS, ETIMEDOUT
from functools import partial
from typing import Any

from netem import _choice, _namespaces
from netem._fabric import VirtualSwitch
from netem._lab_protocol import MessageReceiver, WireError, encode
from netem._udp_counters import read_udp_counters
from netem.conditions import NetworkConditions
from netem.engine import Engine
from netem.errors import ConditionsError, EngineError, NetemError
from netem.forked_program import fork_program, limit_files

_MAX_UNREAD = 64 << 20  # maximum of unread bytes for the orchestrator


@dataclass
class _OpeningConnection:
    """A TCP connection that is being opened for the harness."""

    request: int
    socket: socket.socket
    deadline: float


def _module_of(argv: list[str]) -> Callable[[], None]:
    """Import the module of the command `python -P -m MODULE ARGUMENT...`. Return a function that does what this command
    would do.
    """
    _, _, _, name, *arguments = argv
    module = importlib.import_module(name)

    def main() -> None:
        sys.argv = [name, *arguments]
        module.main()

    return main


class LabServer:
    """A server that executes requests of the harness. The server trusts the sender of the requests, but refuses invalid
    requests.
    """

    def __init__(self, control: socket.socket) -> None:
        control.setblocking(False)
        self._control = control
        self._receiver = MessageReceiver()
        self._unsent: deque[tuple[bytes, list[socket.socket]]] = deque()
        self._children: dict[int, subprocess.Popen[bytes] | None] = {}
        """Process ID -> child, or None if the child is a fork of this process."""
        self._connections: dict[int, _OpeningConnection] = {}
        self._fabric: VirtualSwitch | None = None
        self._engine: Engine | None = None
        self._open = True
        self._selector = selectors.DefaultSelector()
        self._selector.register(control, selectors.EVENT_READ, self._converse)
        # The end of a child wakes the loop through this pipe, which requires a signal handler.
        self._wake, wake_writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(wake_writer, warn_on_full_buffer=False)
        self._selector.register(self._wake, selectors.EVENT_READ, self._reap)

    def run(self) -> None:
        """Run until the harness closes the connection or ends."""
        self._send({"event": "inside"})
        while self._open:
            deadlines = [connection.deadline for connection in self._connections.values()]
            timeout = max(0.0, min(deadlines) - time.monotonic()) if deadlines else None
            for key, events in self._selector.select(timeout):
                key.data(events)
            now = time.monotonic()
            for connection in [c for c in self._connections.values() if c.deadline <= now]:
                self._connected(connection, ETIMEDOUT)

    def _converse(self, events: int) -> None:
        if events & selectors.EVENT_WRITE:
            self._flush()
        if not events & selectors.EVENT_READ or not self._open:
            return
        try:
            self._open = self._receiver.read(self._control) and self._open
            messages = self._receiver.messages()
        except BlockingIOError:
            return
        except (ConnectionError, WireError) as error:
            print(f"The control socket broke: {error}", file=sys.stderr)  # noqa: T201  (the lab's log)
            self._open = False
            return
        self._receiver.close()  # the orchestrator never sends descriptors
        for message in messages:
            self._serve(message)

    def _serve(self, message: dict[str, Any]) -> None:
        request = message.get("id")
        handlers: dict[Any, Callable[[dict[str, Any]], dict[str, Any] | None]] = {
            "open": self._build,
            "spawn": self._spawn,
            "signal": self._signal,
            "connect": self._connect,
            "apply": self._apply,
            "read": lambda _: self._require_engine().read().to_json(),
            "datagrams": self._datagrams,
        }
        handler = handlers.get(message.get("request"))
        try:
            if handler is None:
                raise NetemError(f"request: {message.get('request')!r} is not one of {', '.join(handlers)}")
            result = handler(message)
        except Exception as error:  # a failed request must not end the lab
            if not isinstance(error, (NetemError, OSError)):
                traceback.print_exc()
            self._send({"id": request, "error": _error(error)})
        else:
            if result is not None:  # None: the answer follows later
                self._send({"id": request, "result": result})

    def _send(self, message: dict[str, Any], descriptor: socket.socket | None = None) -> None:
        descriptors = [] if descriptor is None else [descriptor]
        try:
            data = encode({**message, "descriptors": len(descriptors)})
        except WireError as error:
            data = encode({"id": message.get("id"), "error": _error(error)})
        self._unsent.append((data, descriptors))
        self._flush()

    def _flush(self) -> None:
        try:
            while self._unsent:
                data, descriptors = self._unsent[0]
                sent = socket.send_fds(self._control, [data], [d.fileno() for d in descriptors])
                for descriptor in descriptors:
                    descriptor.close()
                # Descriptors go with the first byte.
                self._unsent[0] = (data[sent:], [])
                if sent == len(data):
                    self._unsent.popleft()
        except BlockingIOError:
            if sum(len(data) for data, _ in self._unsent) > _MAX_UNREAD:
                self._open = False
        except OSError:
            self._open = False
        interest = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)
        self._selector.modify(self._control, interest, self._converse)

    # Requests

    def _build(self, message: dict[str, Any]) -> dict[str, Any]:
        if self._fabric is not None:
            raise NetemError("The lab is open already")
        networks = {int(vehicle): descriptor for vehicle, descriptor in message["networks"].items()}
        for descriptor in networks.values():
            os.set_inheritable(descriptor, False)
        self._fabric = VirtualSwitch(message["vehicles"], networks)
        try:
            self._engine, reason = _choice.choose(message["engine"], self._fabric, message["needs"])
        except EngineError as error:
            return {"engine": None, "reason": str(error)}
        return {"engine": self._engine.name, "reason": reason, "networks": self._fabric.inodes()}

    def _spawn(self, message: dict[str, Any]) -> dict[str, Any]:
        mode = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        files: list[int] = []
        most = message["max_file_bytes"]
        try:
            for name in ("stdout", "stderr"):
                files.append(os.open(message[name], mode, 0o644))
            with self._require_fabric().inside(message["vehicle"]):
                limit = None if most is None else partial(limit_files, most)
                if message["fork"]:
                    pid = fork_program(
                        _module_of(message["argv"]),
                        cwd=message["cwd"],
                        env=message["env"],
                        files=(files[0], files[1]),
                        prepare=limit,
                    )
                    self._children[pid] = None
                    return {"pid": pid}
                # All open files are close-on-exec, and `close_fds` closes them again.
                child = subprocess.Popen(
                    message["argv"],
                    cwd=message["cwd"],
                    env=message["env"],
                    stdin=subprocess.DEVNULL,
                    stdout=files[0],
                    stderr=files[1],
                    start_new_session=True,
                    preexec_fn=limit,
                )
        except PermissionError as error:
            raise PermissionError(error.errno, f"{error.strerror} to {_namespaces.user()}", error.filename) from None
        finally:
            for file in files:
                os.close(file)
        self._children[child.pid] = child
        return {"pid": child.pid}

    def _signal(self, message: dict[str, Any]) -> dict[str, Any]:
        pid = message["pid"]
        if pid not in self._children:  # ended or unknown: another process may have this ID now
            return {"sent": False}
        os.killpg(pid, message["signal"])
        return {"sent": True}

    def _connect(self, message: dict[str, Any]) -> None:
        with self._require_fabric().inside(message["vehicle"]):
            client = socket.socket()
        client.setblocking(False)
        deadline = time.monotonic() + message["timeout_s"]
        connection = _OpeningConnection(message["id"], client, deadline)
        code = client.connect_ex((message["host"], message["port"]))
        if code != EINPROGRESS:
            self._answer_connection(connection, code)
            return
        self._connections[client.fileno()] = connection
        self._selector.register(client, selectors.EVENT_WRITE, lambda _: self._connected(connection))

    def _connected(self, connection: _OpeningConnection, code: int | None = None) -> None:
        self._selector.unregister(connection.socket)
        del self._connections[connection.socket.fileno()]
        if code is None:
            code = connection.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        self._answer_connection(connection, code)

    def _answer_connection(self, connection: _OpeningConnection, code: int) -> None:
        if code == 0:
            self._send({"id": connection.request, "result": {}}, connection.socket)
        else:
            connection.socket.close()
            self._send({"id": connection.request, "error": _error(OSError(code, os.strerror(code)))})

    def _apply(self, message: dict[str, Any]) -> dict[str, Any]:
        conditions = NetworkConditions.from_json(message["conditions"])
        return self._require_engine().apply(conditions).to_json()

    def _datagrams(self, _: dict[str, Any]) -> dict[str, Any]:
        fabric = self._require_fabric()
        counted = {}
        for vehicle in fabric.vehicles:
            with fabric.inside(vehicle):
                counted[str(vehicle)] = read_udp_counters()
        return counted

    def _require_fabric(self) -> VirtualSwitch:
        if self._fabric is None:
            raise NetemError("The lab is not open yet")
        return self._fabric

    def _require_engine(self) -> Engine:
        if self._engine is None:
            raise EngineError("The lab has no engine")
        return self._engine

    # Children

    def _reap(self, _: int) -> None:
        """Report the child processes that have ended. The kernel also makes orphaned processes children of this
        process. If an orphaned process ends, it is removed without a report.
        """
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake, 4096)
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid in self._children:
                returncode = os.waitstatus_to_exitcode(status)
                if (child := self._children.pop(pid)) is not None:
                    child.returncode = returncode
                self._send({"event": "exited", "pid": pid, "returncode": returncode})


def _error(error: Exception) -> dict[str, Any]:
    kinds = {ConditionsError: "conditions", EngineError: "engine", OSError: "os"}
    kind = next((name for cls, name in kinds.items() if isinstance(error, cls)), "request")
    message = str(error) if isinstance(error, (NetemError, OSError)) else f"{type(error).__name__}: {error}"
    return {"kind": kind, "message": message, "errno": getattr(error, "errno", None)}


def main() -> None:
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM):
        # Shells and nohup let background commands ignore these signals. Agents must not inherit this.
        signal.signal(number, signal.SIG_DFL)
    control = socket.socket(fileno=int(sys.argv[1]))
    control.set_inheritable(False)
    LabServer(control).run()


if __name__ == "__main__":
    main()
