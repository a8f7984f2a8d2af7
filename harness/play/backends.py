"""List the backends by their names in scenarios, in records and on the command line."""

from typing import Any

from harness.backend_names import BackendName
from harness.play.backend import Backend
from harness.play.containers._container_backend import DockerBackend
from harness.play.process._process_backend import ProcessBackend
from harness.play.simulation.virtual_time import SimulationBackend

BACKENDS: dict[BackendName, Backend] = {
    backend.name: backend for backend in (ProcessBackend(), DockerBackend(), SimulationBackend())
}


def in_virtual_time(name: Any) -> bool:
    """Return true if the backend with this name uses virtual time. Return false for an unknown name."""
    return any(backend.name == name and backend.virtual_time for backend in BACKENDS.values())
