"""The Docker backend as `harness.run.run` sees it."""

import os
from collections.abc import Callable

from harness.archive.directory import RunDirectory
from harness.play.containers import images
from harness.play.containers.engine import DockerError, Engine
from harness.play.containers.lab import ContainerLab
from harness.play.process import agent
from harness.play.process.lab import Lab
from harness.scenario import Scenario


def refuse_what_docker_cannot(scenario: Scenario) -> None:
    """Raises DockerError if there is no engine here that we may use, or not the image that is asked for."""
    engine = Engine.connect()
    try:
        require_root()
        if scenario.docker.image is not None:
            images.named(engine, scenario.docker.image)
    finally:
        engine.close()


def require_root() -> None:
    """Raises DockerError."""
    if os.geteuid() != 0:
        raise DockerError("the Docker backend puts network cables into containers, for which it must be root: use sudo")


def agent_command(scenario: Scenario) -> list[str]:
    """What starts an agent in its container, but for the mission file. Raises ScenarioError."""
    if scenario.docker.image is not None and scenario.agent_command is not None:
        return list(scenario.agent_command)  # a program in the image
    return agent.agent_command(scenario)


async def open_lab(scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> Lab:
    """The lab of containers. Raises DockerError, or as netem.lab.Lab.open does."""
    return await ContainerLab.open(scenario, rundir, say)
