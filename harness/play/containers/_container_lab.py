"""The lab of the Docker backend: the usual virtual network, with containers in place of processes.

    async with await ContainerLab.open(scenario, rundir, say) as lab:
        agent = await lab.spawn(7, [...], role="agent", ...)

Each vehicle has a holder, a container that only keeps a network namespace (see the docstring of
`harness.play.containers`). Containers see the run directory under the same path, so control sockets and files have the
same paths as with processes.
"""

import asyncio
import contextlib
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from socket import socket
from types import TracebackType
from typing import Any, Self

import docker.errors
from docker.types import Mount

from harness.archive.directory import RunDirectory
from harness.play.containers import _images, ownership
from harness.play.containers._container import Container, ContainerOutput, recipe
from harness.play.containers._container_processes import first_process
from harness.play.containers._images import ContainerImage
from harness.play.containers._own_folders import OwnFolders
from harness.play.containers.docker_engine import CLEAN, DockerEngine, DockerError, DockerEvents
from harness.play.containers.ownership import remove
from harness.play.process._run_lab import Role
from harness.play.process.process_preflight import network_needs
from harness.scenario import Scenario
from harness.scenario.agent_options import DockerOptions
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions
from netem.errors import SpawnError
from netem.lab import Lab

LOOK_EVERY_S = 5.0
"""Seconds of wall time between two checks that the Docker engine still answers."""


class ContainerLab:
    """A virtual network whose programs run in containers. The methods raise DockerError and the errors of netem."""

    def __init__(self, engine: DockerEngine, rundir: RunDirectory, scenario: Scenario) -> None:
        self._engine = engine
        self._rundir = rundir
        self._docker = scenario.docker
        self._name = ownership.run_name(rundir.path)
        self._in_named = set(_images.agents_in_named(scenario))
        self._ours: ContainerImage | None = None
        self._named: ContainerImage | None = None
        self._holders: dict[str, int] = {}
        """The vehicle of each holder (a container that keeps a network namespace), by container ID."""
        self._containers: dict[str, Container] = {}
        """All containers that were started, including ended ones, by container ID."""
        self._incarnations: Counter[tuple[int, str]] = Counter()
        self._networks: set[int] = set()
        """Inode numbers of the vehicles' network namespaces."""
        self._events: DockerEvents | None = None
        self.network: Lab
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._closed = False
        self._own_folders = OwnFolders(rundir.agents)

    @classmethod
    async def open(cls, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> "ContainerLab":
        """Start the network. For each vehicle, start an idle container, which keeps the network namespace of the
        vehicle.

        Raises DockerError, and the errors of netem.lab.Lab.open.
        """
        engine = await asyncio.to_thread(DockerEngine.connect)
        lab = cls(engine, rundir, scenario)
        try:
            await lab._choose_images(scenario, say)
            say("starting containers")
            await lab._hold_networks(scenario)
            say("building the lab")
            await lab._connect_cables(scenario, rundir.lab_log)
        except BaseException:
            with contextlib.suppress(DockerError):
                await lab._remove_containers()
            lab._close_all()
            raise
        return lab

    async def _choose_images(self, scenario: Scenario, say: Callable[[str], None]) -> None:
        requested = scenario.docker
        loop = asyncio.get_running_loop()
        stopped = threading.Event()

        def report_step(word: str) -> None:
            if stopped.is_set():
                raise DockerError("the build of the image was interrupted")
            loop.call_soon_threadsafe(say, word)

        def choose() -> tuple[ContainerImage | None, ContainerImage | None]:
            named = None if requested.image is None else _images.named(self._engine, requested.image)
            if named is not None and scenario.vehicles.kind == "none" and self._in_named == set(scenario.roster):
                return None, named
            from_host = requested.image_from_host
            return _images.from_host(self._engine) if from_host else _images.project(self._engine, report_step), named

        try:
            self._ours, self._named = await self._engine.in_thread(choose)
        finally:
            stopped.set()

    async def _hold_networks(self, scenario: Scenario) -> None:
        label = f"{ownership.RUN}={self._name}"
        self._events = await self._engine.in_thread(
            DockerEvents, self._engine, label, self._on_event, asyncio.get_running_loop()
        )
        image = await self._engine.in_thread(_images.from_host, self._engine)
        results = await asyncio.gather(
            *(self._hold(vehicle, image) for vehicle in scenario.roster), return_exceptions=True
        )
        for error in filter(None, results):
            raise error

    async def _hold(self, vehicle: int, image: ContainerImage) -> None:
        name, identity = await self._create(vehicle, "network", image, _images.idle_command(), "none", DockerOptions())
        self._holders[identity] = vehicle
        await self._start(name, identity)

    async def _connect_cables(self, scenario: Scenario, log: Path) -> None:
        networks: dict[int, int] = {}
        try:
            for identity, vehicle in self._holders.items():
                networks[vehicle] = await self._engine.in_thread(self._open_network, identity)
            self._networks = {os.fstat(descriptor).st_ino for descriptor in networks.values()}
            self.network = await Lab.open(
                scenario.network_nodes, needs=network_needs(scenario), networks=networks, log=log
            )
        finally:
            for descriptor in networks.values():
                os.close(descriptor)
        self.addresses = self.network.addresses
        self.broadcast = self.network.broadcast
        self.engine = self.network.engine

    def _open_network(self, identity: str) -> int:
        """Return an open file descriptor of the network namespace of a container."""
        pid = first_process(self._engine, identity)
        with contextlib.suppress(OSError):
            if pid is not None:
                return os.open(f"/proc/{pid}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
        raise DockerError(
            "the Docker engine runs in a virtual machine or on another machine, so the harness cannot connect its "
            "containers to a network: use an engine that runs on this machine"
        )

    async def spawn(
        self,
        vehicle: int,
        argv: Sequence[str],
        *,
        cwd: Path,
        env: Mapping[str, str],
        stdout: Path,
        stderr: Path,
        role: Role,
        max_file_bytes: int | None = None,
    ) -> Container:
        """Start a program in its own container, in the network of a vehicle.

        `max_file_bytes` limits the size of files that the program writes. The limit applies only to programs in an
        image of the harness. Other programs might not handle the signal that the kernel sends at the limit.
        """
        holder = next(identity for identity, held in self._holders.items() if held == vehicle)
        image = self._named if role == "agent" and vehicle in self._in_named else self._ours
        assert image is not None, "the image was chosen before"
        name, identity = await self._create(
            vehicle,
            role,
            image,
            argv,
            f"container:{holder}",
            self._docker,
            max_file_bytes=max_file_bytes if image is self._ours else None,
            working_dir=str(cwd),
            environment=image.environment(env),
        )
        stream = await self._engine.ask(f"attach to {name}", self._attach, identity)
        container = Container(
            self._engine, identity, name, ContainerOutput(stream, stdout, stderr), self._docker.memory_mib
        )
        self._containers[identity] = container
        await self._start(name, identity)
        return container

    def _attach(self, identity: str) -> Any:
        return self._engine.api.attach_socket(identity, {"stdout": 1, "stderr": 1, "stream": 1})

    async def connect(self, vehicle: int, port: int, *, timeout_s: float) -> socket:
        return await self.network.connect(vehicle, port, timeout_s=timeout_s)

    async def apply(self, conditions: NetworkConditions) -> AppliedConditions:
        return await self.network.apply(conditions)

    async def read(self) -> AppliedConditions:
        return await self.network.read()

    async def watch(self) -> None:
        """Wait until Docker stops or does not answer, or until a container is stopped from outside. Then raise
        DockerError.
        """
        while True:
            await asyncio.wait({self._failure}, timeout=LOOK_EVERY_S)
            if self._failure.done():
                self._failure.result()
            await self._engine.ask("ping", self._engine.api.ping)

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            await self._remove_containers()
        except DockerError:
            self._kill_processes()
            raise
        finally:
            self._close_all()
            await self.network.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(DockerError):
            await self.close()

    async def _create(
        self,
        vehicle: int,
        role: str,
        image: ContainerImage,
        argv: Sequence[str],
        network: str,
        limits: DockerOptions,
        max_file_bytes: int | None = None,
        **settings: Any,
    ) -> tuple[str, str]:
        """Create a container, and return its name and ID."""
        self._incarnations[vehicle, role] += 1
        life = self._incarnations[vehicle, role]
        name = f"{self._name}-{role}-{vehicle}" + (f"-{life}" if life > 1 else "")
        kept = await asyncio.to_thread(self._kept, vehicle, role, settings.get("working_dir"))
        options = recipe(self._engine.api, image, argv, kept, network, limits, max_file_bytes)
        labels = ownership.labels(self._name, vehicle, role)
        try:
            created = await self._engine.ask(
                f"create {name}", self._engine.api.create_container, name=name, labels=labels, **options, **settings
            )
        except docker.errors.APIError as error:
            if error.status_code == 409:
                raise DockerError(
                    f"the container {name} of another run in the same directory exists: if that run has ended, remove "
                    f"the container with `ucp-harness clean`, otherwise with docker rm -f {name}"
                ) from None
            raise SpawnError(f"the container {name} cannot be created: {error.explanation}") from None
        return name, created["Id"]

    def _kept(self, vehicle: int, role: str, directory: str | None) -> list[Mount]:
        """Return the mounts of the directories into which the container may write: its own directory, and the directory
        of its keys.
        """
        if directory is None:
            return []
        if role == "agent":
            keys = [self._rundir.keys[vehicle]] if vehicle in self._rundir.keys else []
            own = self._own_folders.mounts(vehicle, Path(directory))
            return [*own, *(Mount(str(path), str(path), type="bind") for path in keys)]
        return [Mount(directory, directory, type="bind")]

    async def _start(self, name: str, identity: str) -> None:
        try:
            await self._engine.ask(f"start {name}", self._engine.api.start, identity)
        except docker.errors.APIError as error:
            raise SpawnError(f"the container {name} cannot be started: {error.explanation}") from None

    def _on_event(self, event: dict[str, Any]) -> None:
        """Process a message from Docker about a container of this lab."""
        if self._closed or self._failure.done():
            return
        if not event:
            self._fail(self._engine.give_up(f"the Docker engine has stopped: start it, then {CLEAN}"))
            return
        identity = event["Actor"]["ID"]
        container = self._containers.get(identity)
        match event["Action"]:
            case "oom" if container:
                container.ran_out_of_memory()
            case "die" if container:
                container.has_ended(int(event["Actor"]["Attributes"]["exitCode"]))
            case "die" if identity in self._holders:
                vehicle = self._holders[identity]
                name = f"{self._name}-network-{vehicle}"
                self._fail(
                    DockerError(
                        f"the container {name}, which holds the network of a vehicle, was stopped from "
                        "outside the harness"
                    )
                )

    def _fail(self, error: DockerError) -> None:
        self._failure.set_exception(error)
        self._failure.exception()  # otherwise asyncio would report an exception that is not retrieved

    async def _remove_containers(self) -> None:
        """Remove all containers of the run, including containers whose creation was interrupted."""
        self._closed = True
        await self._engine.settle()
        containers = await self._engine.ask(
            "list containers", self._engine.api.containers, all=True, filters={"label": f"{ownership.RUN}={self._name}"}
        )
        removed = await asyncio.gather(
            *(
                self._engine.in_thread(remove, self._engine, container["Id"], container["Names"][0][1:])
                for container in containers
            ),
            return_exceptions=True,
        )
        for error in filter(None, removed):
            raise error

    def _kill_processes(self) -> None:
        """Kill all processes in the networks of the lab. The harness uses this function if Docker does not answer."""
        for process in Path("/proc").iterdir():
            if process.name.isdecimal():
                with contextlib.suppress(OSError):
                    if (process / "ns/net").stat().st_ino in self._networks:
                        os.kill(int(process.name), signal.SIGKILL)

    def _close_all(self) -> None:
        self._closed = True
        if self._events is not None:
            self._events.close()
        for container in self._containers.values():
            container.close()
        self._own_folders.merge()
        self._engine.close()
