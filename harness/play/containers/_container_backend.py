"""The Docker backend. It equals the process backend, except that each vehicle and each agent runs in its own container.
The module imports the docker SDK only if a run needs containers, because the import is slow.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from harness.archive.directory import RunDirectory
from harness.backend_names import BackendName
from harness.errors import ScenarioError
from harness.play.process._process_backend import ProcessBackend
from harness.scenario import Scenario

if TYPE_CHECKING:
    from harness.play.process._run_lab import MissionLab


class DockerBackend(ProcessBackend):
    """The backend that runs each vehicle and each agent in a container of its own."""

    name: ClassVar[BackendName] = "docker"
    not_in_uml = (
        "--backend docker does not work with --kernel uml, because User Mode Linux has no Docker engine: "
        "leave out one of them"
    )

    def refuse(self, scenario: Scenario) -> None:
        from harness.play.containers._container_preflight import check_debuggers, check_docker, refuse_variants
        from harness.play.process.process_preflight import refuse_unplayable

        if scenario.remote is not None:
            raise ScenarioError("`remote` does not work with containers: use --backend process, or leave it out")
        refuse_variants()
        check_debuggers(scenario)
        refuse_unplayable(scenario)
        check_docker(scenario)
        self.agent_commands(scenario)

    def agent_command(self, scenario: Scenario, agent_id: int) -> list[str]:
        command = scenario.command_of(agent_id)
        if scenario.docker.image is not None and command is not None:
            return list(command)  # the path of a program in the image
        return super().agent_command(scenario, agent_id)

    async def open_lab(self, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> "MissionLab":
        from harness.play.containers._container_lab import ContainerLab

        return await ContainerLab.open(scenario, rundir, say)
