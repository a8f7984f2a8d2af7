"""What a container is given, and what it is not: the same for each, but for its program and its network."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import docker
from docker.types import LogConfig, Mount

from harness.play.containers.images import Image
from harness.scenario.docker import Docker

MEBIBYTE = 1 << 20
INIT = 1
"""Processes of a container that are not the program's: docker-init, which passes signals on."""


def recipe(
    api: docker.APIClient, image: Image, argv: Sequence[str], kept: Sequence[Path], network_mode: str, limits: Docker
) -> dict[str, Any]:
    """Keywords for the SDK's create_container: no capability, no way to write but into /tmp and what is `kept`.

    That is the run directory, and where the vehicle has its keys, if it has any.
    """
    command = image.command(argv)
    shared = [Mount(str(path), str(path), type="bind", read_only=True) for path in image.shared(argv)]
    host_config = api.create_host_config(
        network_mode=network_mode,
        mounts=[*shared, *(Mount(str(path), str(path), type="bind") for path in kept)],
        tmpfs={"/tmp": ""},  # noqa: S108  (the container's own)
        read_only=True,
        init=True,
        cap_drop=["ALL"],
        security_opt=["no-new-privileges"],
        log_config=LogConfig(type=LogConfig.types.NONE),
        **_limits(limits),
    )
    return {
        "image": image.name,
        "entrypoint": command[:1],
        "command": command[1:],
        "user": f"{os.getuid()}:{os.getgid()}",
        "host_config": host_config,
    }


def _limits(asked: Docker) -> dict[str, Any]:
    limits: dict[str, Any] = {}
    if asked.memory_mib is not None:
        limits["mem_limit"] = limits["memswap_limit"] = asked.memory_mib * MEBIBYTE
    if asked.cpus is not None:
        limits["nano_cpus"] = round(asked.cpus * 1e9)
    if asked.pids is not None:
        limits["pids_limit"] = asked.pids + INIT
    return limits
