"""The names of the backends in scenarios, in records and on the command line. `harness.play` implements them.

The names have a module of their own, because the pytest plugin always imports them and importing `harness.play` would
take too long.
"""

from typing import Literal, get_args

BackendName = Literal["process", "docker", "sim"]
"""The backends: real processes in a private network, the same processes in containers, or virtual time."""

BACKEND_NAMES: tuple[BackendName, ...] = get_args(BackendName)
