"""Containers that a run left behind: its orchestrator was killed, or the engine stopped answering."""

from dataclasses import dataclass, field

import docker.errors

from harness.play.containers import ownership
from harness.play.containers.docker_engine import DockerError, Engine


@dataclass
class Cleaned:
    """Names of containers: what was `removed`, and what is `still` of runs that are going on."""

    removed: list[str] = field(default_factory=list)
    still: list[str] = field(default_factory=list)


def clean(engine: Engine) -> Cleaned:
    """Remove every container of a run that is over, and nothing else. Raises DockerError."""
    cleaned = Cleaned()
    for container in engine.do("list containers", engine.api.containers, all=True, filters={"label": ownership.RUN}):
        name = container["Names"][0].removeprefix("/")
        if ownership.lives(container["Labels"].get(ownership.OWNER, "")):
            cleaned.still.append(name)
        else:
            remove(engine, container["Id"], name)
            cleaned.removed.append(name)
    return cleaned


def remove(engine: Engine, identity: str, name: str) -> None:
    """Kill and remove a container, and what it wrote. Raises DockerError."""
    try:
        engine.do(f"remove {name}", engine.api.remove_container, identity, v=True, force=True)
    except docker.errors.APIError as error:
        if error.status_code not in (404, 409):  # it is gone, or somebody is at it
            raise DockerError(f"the container {name} could not be removed: {error.explanation}") from None
