"""The lab of containers: `netem`'s network, and on it containers in place of processes.

    async with await ContainerLab.open(scenario, rundir, say) as lab:
        agent = await lab.spawn(7, [...], role="agent", ...)

Every vehicle has a holder, a container that only keeps a network namespace; see the package. Containers share the run
directory, at the same path, so control sockets and files are where they are for processes.
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

from harness.archive.directory import RunDirectory
from harness.play.containers import _images, ownership
from harness.play.containers._container import Container, Output, recipe
from harness.play.containers._images import Image
from harness.play.containers.docker_engine import CLEAN, DockerError, Engine, Events
from harness.play.containers.ownership import remove
from harness.play.process._run_lab import Role
from harness.play.process.process_preflight import network_needs
from harness.scenario import Scenario
from harness.scenario.agent_options import Docker
from netem.conditions import NetworkConditions
from netem.engine import Applied
from netem.errors import SpawnError
from netem.lab import Lab

LOOK_EVERY_S = 5.0
"""Wall time between two looks at whether the engine still answers."""


class ContainerLab:
    """Made by `ContainerLab.open` only. Errors are DockerError, and netem's."""

    def __init__(self, engine: Engine, rundir: RunDirectory, scenario: Scenario) -> None:
        self._engine = engine
        self._rundir = rundir
        self._docker = scenario.docker
        self._name = ownership.run_name(rundir.path)
        self._in_named = set(_images.agents_in_named(scenario))
        self._ours: Image | None = None
        self._named: Image | None = None
        self._holders: dict[str, int] = {}
        """ID of a holder -> its vehicle."""
        self._containers: dict[str, Container] = {}
        """ID -> those that were started, whether they run or not."""
        self._lives: Counter[tuple[int, str]] = Counter()
        self._networks: set[int] = set()
        """The vehicles' network namespaces, by inode number."""
        self._events: Events | None = None
        self.network: Lab
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._closed = False

    @classmethod
    async def open(cls, scenario: Scenario, rundir: RunDirectory, say: Callable[[str], None]) -> "ContainerLab":
        """Bring up the network with a holder for each vehicle. Raises DockerError, or as netem.lab.Lab.open does."""
        engine = await asyncio.to_thread(Engine.connect)
        lab = cls(engine, rundir, scenario)
        try:
            await lab._choose_images(scenario, say)
            say("starting containers")
            await lab._hold_networks(scenario)
            say("building the lab")
            await lab._lay_cables(scenario, rundir.lab_log)
        except BaseException:
            with contextlib.suppress(DockerError):
                await lab._remove_containers()
            lab._let_go()
            raise
        return lab

    async def _choose_images(self, scenario: Scenario, say: Callable[[str], None]) -> None:
        asked = scenario.docker
        loop = asyncio.get_running_loop()
        over = threading.Event()

        def tell(word: str) -> None:
            if over.is_set():
                raise DockerError("the build of the image was interrupted")
            loop.call_soon_threadsafe(say, word)

        def choose() -> tuple[Image | None, Image | None]:
            named = None if asked.image is None else _images.named(self._engine, asked.image)
            if named is not None and scenario.vehicles.kind == "none" and self._in_named == set(scenario.roster):
                return None, named
            from_host = asked.image_from_host
            return _images.from_host(self._engine) if from_host else _images.project(self._engine, tell), named

        try:
            self._ours, self._named = await self._engine.in_thread(choose)
        finally:
            over.set()

    async def _hold_networks(self, scenario: Scenario) -> None:
        label = f"{ownership.RUN}={self._name}"
        self._events = await self._engine.in_thread(Events, self._engine, label, self._hear, asyncio.get_running_loop())
        image = await self._engine.in_thread(_images.from_host, self._engine)
        held = await asyncio.gather(
            *(self._hold(vehicle, image) for vehicle in scenario.roster), return_exceptions=True
        )
        for error in filter(None, held):
            raise error

    async def _hold(self, vehicle: int, image: Image) -> None:
        name, identity = await self._create(vehicle, "network", image, _images.idle_command(), "none", Docker())
        self._holders[identity] = vehicle
        await self._start(name, identity)

    async def _lay_cables(self, scenario: Scenario, log: Path) -> None:
        networks: dict[int, int] = {}
        try:
            for identity, vehicle in self._holders.items():
                networks[vehicle] = await self._engine.in_thread(self._open_network, identity)
            self._networks = {os.fstat(descriptor).st_ino for descriptor in networks.values()}
            self.network = await Lab.open(
                scenario.on_the_air, needs=network_needs(scenario), networks=networks, log=log
            )
        finally:
            for descriptor in networks.values():
                os.close(descriptor)
        self.addresses = self.network.addresses
        self.broadcast = self.network.broadcast
        self.engine = self.network.engine

    def _open_network(self, identity: str) -> int:
        """A descriptor of the network namespace that a holder keeps."""
        state = self._engine.do("look at a container", self._engine.api.inspect_container, identity)["State"]
        pid = state["Pid"]
        with contextlib.suppress(OSError):
            if identity in Path(f"/proc/{pid}/cgroup").read_text():  # and not some process of the same number
                return os.open(f"/proc/{pid}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
        raise DockerError(
            "the Docker engine runs in a virtual machine or on another machine, so the harness cannot connect its "
            "containers to a network: use an engine that runs on this machine"
        )

    # As netem.lab.Lab

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
    ) -> Container:
        """Start a program in a container of its own, in the vehicle's network."""
        holder = next(identity for identity, held in self._holders.items() if held == vehicle)
        image = self._named if role == "agent" and vehicle in self._in_named else self._ours
        assert image is not None, "it is there for whoever needs it"
        name, identity = await self._create(
            vehicle,
            role,
            image,
            argv,
            f"container:{holder}",
            self._docker,
            working_dir=str(cwd),
            environment=image.environment(env),
        )
        stream = await self._engine.ask(f"attach to {name}", self._attach, identity)
        container = Container(self._engine, identity, name, Output(stream, stdout, stderr), self._docker.memory_mib)
        self._containers[identity] = container
        await self._start(name, identity)
        return container

    def _attach(self, identity: str) -> Any:
        return self._engine.api.attach_socket(identity, {"stdout": 1, "stderr": 1, "stream": 1})

    async def connect(self, vehicle: int, port: int, *, timeout_s: float) -> socket:
        return await self.network.connect(vehicle, port, timeout_s=timeout_s)

    async def apply(self, conditions: NetworkConditions) -> Applied:
        return await self.network.apply(conditions)

    async def read(self) -> Applied:
        return await self.network.read()

    async def watch(self) -> None:
        """Raises DockerError once the engine is gone or silent, or somebody ends a holder."""
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
            self._kill_by_hand()
            raise
        finally:
            self._let_go()
            await self.network.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(DockerError):
            await self.close()

    # Containers

    async def _create(
        self, vehicle: int, role: str, image: Image, argv: Sequence[str], network: str, limits: Docker, **settings: Any
    ) -> tuple[str, str]:
        """Create a container; its name and ID."""
        self._lives[vehicle, role] += 1
        life = self._lives[vehicle, role]
        name = f"{self._name}-{role}-{vehicle}" + (f"-{life}" if life > 1 else "")
        kept = [self._rundir.path, *([self._rundir.keys[vehicle]] if vehicle in self._rundir.keys else [])]
        given = recipe(self._engine.api, image, argv, kept, network, limits)
        labels = ownership.labels(self._name, vehicle, role)
        try:
            made = await self._engine.ask(
                f"create {name}", self._engine.api.create_container, name=name, labels=labels, **given, **settings
            )
        except docker.errors.APIError as error:
            if error.status_code == 409:
                raise DockerError(
                    f"the container {name} of another run in the same directory exists: if that run has ended, remove "
                    f"the container with `ucp-harness clean`, otherwise with docker rm -f {name}"
                ) from None
            raise SpawnError(f"the container {name} cannot be created: {error.explanation}") from None
        return name, made["Id"]

    async def _start(self, name: str, identity: str) -> None:
        try:
            await self._engine.ask(f"start {name}", self._engine.api.start, identity)
        except docker.errors.APIError as error:
            raise SpawnError(f"the container {name} cannot be started: {error.explanation}") from None

    def _hear(self, event: dict[str, Any]) -> None:
        """What the engine says of our containers."""
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
        self._failure.exception()  # it may be that nobody asks for it

    async def _remove_containers(self) -> None:
        """All of the run, also those that were under way when somebody stopped waiting for them."""
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

    def _kill_by_hand(self) -> None:
        """End every process in our networks: the engine does not answer."""
        for process in Path("/proc").iterdir():
            if process.name.isdecimal():
                with contextlib.suppress(OSError):
                    if (process / "ns/net").stat().st_ino in self._networks:
                        os.kill(int(process.name), signal.SIGKILL)

    def _let_go(self) -> None:
        self._closed = True
        if self._events is not None:
            self._events.close()
        for container in self._containers.values():
            container.close()
        self._engine.close()
