"""What containers are made from and may use, where a scenario is played on Docker."""

from typing import Annotated

from pydantic import Field

from harness.scenario.strict_model import Model

MIN_MEMORY_MIB = 6
"""Docker refuses a container that may use less."""


class Docker(Model):
    """Limits are of each container by itself; none: the machine's. Other backends pass over all of this."""

    image: Annotated[str, Field(min_length=1, max_length=255)] | None = None
    """In which agents run; the project's own, unless given. `agent_command` is a program in it; if that names agents,
    the others do not run in it."""
    image_from_host: bool = False
    """This machine's own programs and packages, read-only, instead of the project's image."""
    memory_mib: Annotated[int, Field(ge=MIN_MEMORY_MIB, strict=True)] | None = None
    cpus: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] | None = None
    """How many processors' worth of time."""
    pids: Annotated[int, Field(ge=1, strict=True)] | None = None
    """How many processes and threads."""
