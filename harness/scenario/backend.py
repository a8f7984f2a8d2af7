"""The backends by name, as scenarios, records and the command line say it: what they are is in `harness.play`."""

from typing import Literal, get_args

BackendName = Literal["process", "docker", "sim"]
"""Real processes in a private network, the same in containers, or virtual time."""

BACKEND_NAMES: tuple[BackendName, ...] = get_args(BackendName)
