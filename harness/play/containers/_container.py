"""Run a program of the lab in a container, and define the options of this container."""

import asyncio
import contextlib
import os
import signal
import socket
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import docker
import docker.errors
from docker.types import LogConfig, Mount, Ulimit

from harness.play.containers._container_processes import end_program, first_process
from harness.play.containers._images import ContainerImage
from harness.play.containers.docker_engine import DockerEngine
from harness.scenario.agent_options import DockerOptions
from netem.lab import in_words

STDOUT, STDERR = 1, 2
_FRAME = struct.Struct(">B3xI")
_READ_BYTES = 1 << 16
_LAST_WORDS_S = 1.0
"""Seconds of wall time after the end of a container during which its last output may still arrive."""
_KILLED_BY_SIGNAL = 128  # exit status of a shell or of docker-init after a signal, minus its number
_NO_SUCH_PROGRAM = 127


class ContainerOutput:
    """A copier that writes the output of a container to two files.

    The output comes from the stream of `docker attach`. The stream consists of frames: number of the output, 3 unused
    bytes, length (u32, big-endian), content (Docker Engine API, "Attach to a container", stream format).
    """

    def __init__(self, stream: Any, stdout: Path, stderr: Path) -> None:
        """Open the files, and start to copy the output. `stream` comes from the Docker SDK. Raises OSError if a file
        cannot be opened.
        """
        self._stream = stream  # a reference keeps the HTTP response, which owns the socket, alive
        self._socket: socket.socket = stream._sock
        self._socket.setblocking(False)
        self._files: dict[int, BinaryIO] = {STDOUT: stdout.open("ab"), STDERR: stderr.open("ab")}
        self._unread = bytearray()
        self._loop = asyncio.get_running_loop()
        self.ended = asyncio.Event()
        self._loop.add_reader(self._socket, self._read)

    def _read(self) -> None:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._unread += data
        with contextlib.suppress(OSError):  # the disk may be full, and the container must not wait
            self._write()

    def _write(self) -> None:
        while len(self._unread) >= _FRAME.size:
            output, length = _FRAME.unpack_from(self._unread)
            end = _FRAME.size + length
            if len(self._unread) < end:
                return
            content = bytes(self._unread[_FRAME.size : end])
            del self._unread[:end]
            file = self._files[STDERR if output == STDERR else STDOUT]
            file.write(content)
            file.flush()

    def close(self) -> None:
        if self.ended.is_set():
            return
        self._loop.remove_reader(self._socket)
        self._stream.close()
        for file in self._files.values():
            with contextlib.suppress(OSError):
                file.close()
        self.ended.set()


class Container:
    """A container that runs one program. The lab calls `has_ended` when the container ends."""

    def __init__(
        self, engine: DockerEngine, identity: str, name: str, output: ContainerOutput, memory_mib: int | None
    ) -> None:
        self._engine = engine
        self.identity = identity
        self.name = name
        self._output = output
        self._memory_mib = memory_mib
        self._ended: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._paused = False
        self._out_of_memory = False
        self._ending: asyncio.Task[None] | None = None
        self.left_behind: list[str] = []

    @property
    def returncode(self) -> int | None:
        return self._ended.result() if self._ended.done() else None

    @property
    def end(self) -> str:
        returncode = self._ended.result()
        if self._out_of_memory:
            limit = f": it may use {self._memory_mib} MiB (`docker.memory_mib`)" if self._memory_mib else ""
            return f"{in_words(returncode)}, out of memory{limit}"
        if returncode == _NO_SUCH_PROGRAM:
            return f"{in_words(returncode)}: its image does not hold this program"
        return in_words(returncode)

    async def wait(self) -> int:
        return await asyncio.shield(self._ended)

    async def send_signal(self, number: int) -> None:
        if number == signal.SIGKILL and self._paused:
            await self.resume()  # the engine cannot kill a paused container
        await self._call_engine("signal", self._engine.api.kill, signal.Signals(number).name)

    async def pause(self) -> None:
        await self._call_engine("pause", self._engine.api.pause)
        self._paused = True

    async def resume(self) -> None:
        if self._paused:
            await self._call_engine("resume", self._engine.api.unpause)
            self._paused = False

    async def terminate(self, grace_s: float) -> int:
        await self.resume()
        init = None if self._ended.done() else await self._engine.in_thread(first_process, self._engine, self.identity)
        try:
            if init is None:
                raise ProcessLookupError
            self.left_behind = await asyncio.to_thread(end_program, init, grace_s)
        except OSError:  # the container has just ended, or the engine runs it as another user
            await self.send_signal(signal.SIGTERM)
        try:
            return await asyncio.wait_for(self.wait(), grace_s)
        except TimeoutError:
            await self.send_signal(signal.SIGKILL)
            return await self.wait()

    async def _call_engine(self, what: str, call: Any, *arguments: Any) -> None:
        if self._ended.done():
            return
        try:
            await self._engine.ask(f"{what} {self.name}", call, self.identity, *arguments)
        except docker.errors.APIError as error:
            if error.status_code not in (404, 409):  # the container has just ended
                raise

    # Events of the engine, forwarded by the lab

    def ran_out_of_memory(self) -> None:
        self._out_of_memory = True

    def has_ended(self, status: int) -> None:
        returncode = _KILLED_BY_SIGNAL - status if _is_signal(status - _KILLED_BY_SIGNAL) else status
        self._ending = asyncio.get_running_loop().create_task(self._end(returncode))

    async def _end(self, returncode: int) -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._output.ended.wait(), _LAST_WORDS_S)
        self.close(returncode)

    def close(self, returncode: int = -signal.SIGKILL) -> None:
        """Store the exit status of the program, and close the output files."""
        self._output.close()
        if not self._ended.done():
            self._ended.set_result(returncode)


def _is_signal(number: int) -> bool:
    return number in set(signal.Signals)


MEBIBYTE = 1 << 20
INIT = 1
"""Number of additional processes in a container. The additional process is docker-init, which forwards signals."""


def recipe(
    api: docker.APIClient,
    image: ContainerImage,
    argv: Sequence[str],
    kept: Sequence[Mount],
    network_mode: str,
    limits: DockerOptions,
    max_file_bytes: int | None = None,
) -> dict[str, Any]:
    """Return the keyword arguments that let the Docker SDK create a container for a program.

    The container has no capabilities. It can write only into /tmp and the directories in `kept`.
    """
    command = image.command(argv)
    shared = [Mount(str(path), str(path), type="bind", read_only=True) for path in image.shared(argv)]
    host_config = api.create_host_config(
        network_mode=network_mode,
        mounts=[*shared, *kept],
        tmpfs={"/tmp": ""},  # noqa: S108  (inside the container)
        read_only=True,
        init=True,
        cap_drop=["ALL"],
        security_opt=["no-new-privileges"],
        log_config=LogConfig(type=LogConfig.types.NONE),
        **_limits(limits, max_file_bytes),
    )
    return {
        "image": image.name,
        "entrypoint": command[:1],
        "command": command[1:],
        "user": f"{os.getuid()}:{os.getgid()}",
        "host_config": host_config,
    }


def _limits(limits_asked: DockerOptions, max_file_bytes: int | None) -> dict[str, Any]:
    limits: dict[str, Any] = {}
    if max_file_bytes is not None:
        limits["ulimits"] = [Ulimit(name="fsize", soft=max_file_bytes, hard=max_file_bytes)]
    if limits_asked.memory_mib is not None:
        limits["mem_limit"] = limits["memswap_limit"] = limits_asked.memory_mib * MEBIBYTE
    if limits_asked.cpus is not None:
        limits["nano_cpus"] = round(limits_asked.cpus * 1e9)
    if limits_asked.pids is not None:
        limits["pids_limit"] = limits_asked.pids + INIT
    return limits
