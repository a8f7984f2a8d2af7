"""Check before a run that this machine can run the scenario in containers."""

import os
import shutil
from pathlib import Path

from harness.play.containers import _images
from harness.play.containers.docker_engine import DockerEngine, DockerError
from harness.play.variant import variant_in_use
from harness.scenario import Scenario


def check_docker(scenario: Scenario) -> None:
    """Raise DockerError if this machine cannot use Docker, or if the requested image is missing."""
    engine = DockerEngine.connect()
    try:
        require_root()
        if scenario.docker.image is not None:
            _images.named(engine, scenario.docker.image)
    finally:
        engine.close()


def refuse_variants() -> None:
    """Raise DockerError if a protocol variant is in use, because the image cannot read the variant's file."""
    if (variant := variant_in_use()) is not None:
        raise DockerError(f"--backend docker cannot play the variant {variant.name}: choose --backend process or sim")


def check_debuggers(scenario: Scenario) -> None:
    """Raise DockerError if a vehicle needs a debugger that its image does not contain. The project's image has no
    debuggers. An image with the programs of this machine has the debuggers of this machine.
    """
    setups = (scenario.vehicles.setup_of(vehicle) for vehicle in scenario.roster)
    for debugger in sorted({setup.debugger for setup in setups if setup.debugger is not None}):
        if not scenario.docker.image_from_host:
            raise DockerError(
                f"the project's image has no {debugger}: use this machine's files (--image-from-host, "
                "`docker.image_from_host`), or leave out `debugger`"
            )
        here = shutil.which(debugger)
        if here is not None and not _images.is_shared(Path(here)):
            raise DockerError(
                f"{here} is in a directory that containers do not share with this machine: install {debugger} from "
                "the packages of this machine, or leave out `debugger`"
            )


def require_root() -> None:
    """Raise DockerError if the user is not root."""
    if os.geteuid() != 0:
        raise DockerError("the Docker backend must be root to add network interfaces to containers: use sudo")
