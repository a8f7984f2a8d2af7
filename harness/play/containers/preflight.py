"""What containers on this machine cannot do, found out before anything starts."""

import os

from harness.play.containers import images
from harness.play.containers.engine import DockerError, Engine
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
