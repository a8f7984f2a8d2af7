"""Use Docker in tests: list the containers of a run, and interrupt the connection to Docker."""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from harness.play.containers import ownership
from harness.play.containers._images import HOST_IMAGE, from_host, idle_command
from harness.play.containers.docker_engine import DEFAULT_HOST, DockerEngine


def containers(run: Path) -> list[str]:
    """Return the names of all containers of the run in this directory. Stopped containers are included."""
    engine = DockerEngine.connect()
    found = engine.api.containers(all=True, filters={"label": f"{ownership.RUN}={ownership.run_name(run)}"})
    engine.close()
    return sorted(one["Names"][0].removeprefix("/") for one in found)


@contextmanager
def foreign_container(name: str) -> Iterator[DockerEngine]:
    """Start a container that does not belong to any run."""
    engine = DockerEngine.connect()
    image = from_host(engine)
    settings = engine.api.create_host_config(network_mode="none", binds=[f"{it}:{it}:ro" for it in image.mounted])
    made = engine.api.create_container(HOST_IMAGE, idle_command(), name=name, host_config=settings)
    engine.api.start(made["Id"])
    try:
        yield engine
    finally:
        engine.api.remove_container(made["Id"], force=True)
        engine.close()


class BreakableConnection:
    """A socket that forwards everything to Docker until a test calls `silent` or `cut`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._engine = (os.environ.get("DOCKER_HOST") or DEFAULT_HOST).removeprefix("unix://")
        self._open = threading.Event()
        self._open.set()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(100)
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def silent(self) -> None:
        """Accept further connections, but forward nothing."""
        self._open.clear()

    def cut(self) -> None:
        self._listener.close()
        for connection in self._connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self.path.unlink()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.socket(socket.AF_UNIX)
                far.connect(self._engine)
                self._connections += [near, far]
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(one, other), daemon=True).start()

    def _carry(self, one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(1 << 16):
                self._open.wait()
                other.sendall(data)
            other.shutdown(socket.SHUT_WR)
