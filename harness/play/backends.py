"""The table of backends: what the names stand for that scenarios, records and the command line have."""

from typing import Any

from harness.backend_names import BackendName
from harness.play.backend import Backend
from harness.play.containers._container_backend import Containers
from harness.play.process._process_backend import Processes
from harness.play.simulation.virtual_time import VirtualTime

BACKENDS: dict[BackendName, Backend] = {backend.name: backend for backend in (Processes(), Containers(), VirtualTime())}


def in_virtual_time(name: Any) -> bool:
    """Whether the backend that a record names was in virtual time; one that is unknown here was not."""
    return any(backend.name == name and backend.virtual_time for backend in BACKENDS.values())
