"""The backends by name, as scenarios, records and the command line say it: what they are is in `harness.play`.

It is in no room, for the pytest plugin needs it where nobody asked for a swarm, and should cost nothing there.
"""

from typing import Literal, get_args

BackendName = Literal["process", "docker", "sim"]
"""Real processes in a private network, the same in containers, or virtual time."""

BACKEND_NAMES: tuple[BackendName, ...] = get_args(BackendName)
