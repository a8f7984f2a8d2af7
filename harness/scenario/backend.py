"""The backends by name: what plays a scenario."""

from typing import Literal, get_args

Backend = Literal["process", "docker", "sim"]
"""Real processes in a private network, the same in containers, or virtual time."""

BACKENDS: tuple[Backend, ...] = get_args(Backend)
