"""The workers of a Dask cluster that run the agents and the vehicle programs of one run.

Each run has a secret of its own. Dask sends this secret to the workers, together with the address at which the harness
listens. Each worker executes one task, which lasts as long as the run. Dask would start the task of a lost worker
again. The harness refuses the agents of this second task, because the data of the first agents are lost.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from harness.errors import MachineError
from harness.play.hosts._placement import place
from harness.play.hosts._worker_connection import FarVehicle, WorkerConnection
from harness.play.hosts._worker_task import HostOrder, play_agents
from harness.play.machine.dask_cluster import connected

if TYPE_CHECKING:
    from harness.play.remote._far_ends import FarEnd

BACKLOG = 512
WATCH_EVERY_S = 0.5
END_LIMIT_S = 10.0
"""Maximum seconds of wall time between the end of the run and the ends of the workers' tasks."""


class AgentHosts:
    """The workers of a Dask cluster that run the agents of a run. Each worker runs some of the agents."""

    def __init__(self, client: Any, commands: Mapping[int, Sequence[str] | None]) -> None:
        """Distribute the agents over the workers. `commands` contains the command of each agent, or None for the agent
        of the harness.
        """
        self._client, self._commands = client, commands
        self._placed = place([*commands], client.nthreads())
        self._worker_of = {agent: worker for worker, agents in self._placed.items() for agent in agents}
        self._listeners: dict[str, socket.socket] = {}
        self._tasks: list[Any] = []
        self._ended: dict[str, asyncio.Future[None]] = {}
        """A future for each worker, which becomes done when the task of the worker ends."""
        self._loop = asyncio.get_running_loop()
        self._connections: dict[str, asyncio.Future[WorkerConnection]] = {
            worker: self._loop.create_future() for worker in self._placed
        }
        self._vehicles: dict[int, FarVehicle] = {}
        self._problem: asyncio.Future[str] = self._loop.create_future()
        self.secret = secrets.token_bytes(32)

    @classmethod
    @asynccontextmanager
    async def opened(cls, scheduler: str, commands: Mapping[int, Sequence[str] | None]) -> AsyncIterator[AgentHosts]:
        """Connect to the Dask scheduler for the duration of the context. Raises the errors of `connected`."""
        connection = connected(scheduler)
        client = await asyncio.to_thread(connection.__enter__)
        try:
            hosts = cls(client, commands)
            try:
                yield hosts
            finally:
                await hosts._end()
        finally:
            await asyncio.to_thread(connection.__exit__, None, None, None)

    @property
    def agents(self) -> Sequence[int]:
        return [*self._commands]

    def worker_of(self, agent_id: int) -> str:
        """Return the address of the worker that runs the agent."""
        return self._worker_of[agent_id]

    def listen(self) -> list[socket.socket]:
        """Listen at each address of this machine at which a worker can connect. Return the sockets, which the caller
        must close. Raises MachineError if a worker cannot be reached.
        """
        for worker in self._placed:
            where = _own_address(worker)
            if where not in self._listeners:
                self._listeners[where] = _listener(where)
        return [*self._listeners.values()]

    def start(self) -> None:
        """Let each worker start its agents. The agents connect to the addresses of `listen`."""
        for worker, agents in self._placed.items():
            host, port = self._listeners[_own_address(worker)].getsockname()[:2]
            commands = {agent: _words(self._commands[agent]) for agent in agents}
            order = HostOrder(worker, host, port, self.secret.hex(), commands)
            task = self._client.submit(play_agents, order, workers=[worker], pure=False, allow_other_workers=False)
            task.add_done_callback(partial(self._notify, worker))
            self._tasks.append(task)
            self._ended[worker] = self._loop.create_future()

    # The connections of the workers

    def refusal(self, worker: str) -> str:
        """Return the sentence with which the run refuses the connection of a worker. Return an empty text if the run
        accepts the connection.
        """
        if (connection := self._connections.get(worker)) is None:
            return f"this run has no worker {worker}"
        return "the worker has begun in another process, and its data are lost with it" if connection.done() else ""

    async def receive(self, far_end: FarEnd, record_lag: Callable[[str, bytes], None]) -> None:
        """Accept the connection of a worker. The function `record_lag` is called with the ID of the worker's first
        agent, and with a line that contains a measurement of the worker's delays. Raises OSError.
        """
        worker = far_end.session
        first = str(self._placed[worker][0])
        connection = WorkerConnection(worker, partial(record_lag, first))
        await connection.open(far_end)
        self._connections[worker].set_result(connection)

    async def joined(self) -> None:
        """Wait until all workers have connected."""
        await asyncio.gather(*map(asyncio.shield, self._connections.values()))

    def measure_lag(self, epochs_us: Mapping[int, int | None], speedup: float) -> None:
        """Let each worker measure its delays. `epochs_us` contains the start of the mission on the clock of each
        agent's computer.
        """
        for worker, agents in self._placed.items():
            epoch_us = next((epochs_us[agent] for agent in agents if epochs_us[agent] is not None), None)
            if epoch_us is not None:
                self._connections[worker].result().measure_lag(epoch_us, speedup)

    # Vehicle programs: the methods of harness.play.process._run_lab.VehicleLab

    async def spawn(
        self,
        vehicle: int,
        argv: Sequence[str],
        *,
        cwd: Path,
        env: Mapping[str, str],
        stdout: Path,
        stderr: Path,
        role: str,
        max_file_bytes: int | None = None,
    ) -> FarVehicle:
        """Start the program of a vehicle on the worker of its agent, with the environment variables of the worker.
        Raises SpawnError.
        """
        program = await self._connection_of(vehicle).start(vehicle, argv, cwd, stdout)
        self._vehicles[vehicle] = program
        return program

    async def connect(self, vehicle: int, port: int, *, timeout_s: float) -> socket.socket:
        return await self._connection_of(vehicle).connect(self._vehicles[vehicle], port, timeout_s)

    def lost_worker(self, vehicle: int) -> str | None:
        """Return None if the worker that runs the vehicle is connected. Return the address of the worker if the worker
        is lost.
        """
        connection = self._connection_of(vehicle)
        return connection.worker if connection.is_lost else None

    def _connection_of(self, vehicle: int) -> WorkerConnection:
        return self._connections[self._worker_of[vehicle]].result()

    # The end of tasks

    def _notify(self, worker: str, task: Any) -> None:
        """Report the end of a task. A thread of Dask calls this method."""
        problem = f"the worker at {worker} cannot play its agents: {task.exception()}" if task.status == "error" else ""
        with contextlib.suppress(RuntimeError):  # the run is over
            self._loop.call_soon_threadsafe(self._finish, worker, problem)

    def _finish(self, worker: str, problem: str) -> None:
        if not self._ended[worker].done():
            self._ended[worker].set_result(None)
        if problem and not self._problem.done():
            self._problem.set_result(problem)

    async def watch(self) -> None:
        """Wait until a worker is lost, or ends its task with an error. Then raise MachineError. After the start of the
        mission, the loss of a worker only cuts off its agents.
        """
        while not self._problem.done():
            present = await asyncio.to_thread(self._client.nthreads)
            if lost := [worker for worker in self._placed if worker not in present]:
                raise MachineError(f"the worker at {lost[0]} was lost before the mission began: start it again")
            await asyncio.wait([self._problem], timeout=WATCH_EVERY_S)
        raise MachineError(self._problem.result())

    async def _end(self) -> None:
        """Wait until the workers have ended their agents. A worker ends its agents when the harness stops listening."""
        for connection in self._connections.values():
            if connection.done():
                connection.result().close()
        with contextlib.suppress(OSError):  # the scheduler is lost
            present = await asyncio.to_thread(self._client.nthreads)
            if waiting := [ended for worker, ended in self._ended.items() if worker in present]:
                await asyncio.wait(waiting, timeout=END_LIMIT_S)


def _words(command: Sequence[str] | None) -> list[str] | None:
    return None if command is None else [*command]


def _own_address(worker: str) -> str:
    """Return the address of this machine from which it sends packets to the worker. Raises MachineError."""
    parts = urlsplit(worker)
    try:
        family, _, _, _, place = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(place)  # of a datagram socket: no packet is sent
            return str(probe.getsockname()[0])
    except OSError as error:
        raise MachineError(f"the worker at {worker} cannot be reached from here ({error.strerror})") from None


def _listener(host: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.bind((host, 0))
    listener.listen(BACKLOG)
    listener.setblocking(False)
    return listener
