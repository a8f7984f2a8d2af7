"""Call Docker with the docker SDK. Calls run in threads with a time limit, and each error is one sentence.

If the engine fails to answer once, all later calls fail immediately, because otherwise each call would wait for the
time limit.
"""

import asyncio
import concurrent.futures
import os
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, ParamSpec, TypeVar

import docker
import docker.errors
import requests

from harness.errors import MachineError
from netem.errors import LabError

DEFAULT_HOST = "unix:///var/run/docker.sock"
GREETING_LIMIT_S = 10.0
ANSWER_LIMIT_S = 30.0
CLEAN = "`ucp-harness clean` removes what is left"
AT_ONCE = 8
"""Maximum number of simultaneous calls of the Docker SDK. A higher number would not be faster."""

P = ParamSpec("P")
T = TypeVar("T")


class DockerError(MachineError, LabError):
    """An error: Docker is missing, or refuses a request."""


class DockerEngine:
    """The connection to Docker. Call the functions of the SDK object `api` only through the method `do`, or in
    asynchronous code through the method `ask`.
    """

    def __init__(self, api: docker.APIClient) -> None:
        self.api = api
        self._threads = ThreadPoolExecutor(AT_ONCE, "docker")
        self._pending: set[Future[Any]] = set()
        self._failure: DockerError | None = None

    @classmethod
    def connect(cls) -> "DockerEngine":
        """Connect to Docker on this machine. Raises DockerError."""
        host = os.environ.get("DOCKER_HOST") or DEFAULT_HOST
        if not host.startswith("unix://"):
            raise DockerError(
                f"DOCKER_HOST is {host}: the harness connects only containers on this machine to a network: unset it, "
                "or name the socket of a local engine (unix://...)"
            )
        _check_socket(host.removeprefix("unix://"))
        try:
            api = docker.APIClient(host, version="auto", timeout=round(GREETING_LIMIT_S))
        except docker.errors.DockerException as error:
            raise DockerError(
                f"the Docker engine at {host} does not answer: restart it (systemctl restart docker) ({error})"
            ) from None
        api.timeout = round(ANSWER_LIMIT_S)
        return cls(api)

    def do(self, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function of the SDK, and return its result. `what` names the call in error messages. Raises
        DockerError, or the SDK's APIError if Docker refuses the call.
        """
        if self._failure is not None:
            raise self._failure
        try:
            return call(*args, **kwargs)
        except docker.errors.APIError as error:
            if "no space left on device" in str(error.explanation):
                raise DockerError(
                    f"the Docker engine's disk is full ({what}): free some of it, for example with docker system prune"
                ) from None
            raise
        except (requests.exceptions.RequestException, OSError):
            sentence = f"the Docker engine stopped answering ({what}): once it answers again (docker ps), {CLEAN}"
            raise self.give_up(sentence) from None

    def give_up(self, sentence: str) -> DockerError:
        """Record a failure of Docker, so that all later calls raise an error. Return the error of the first failure."""
        self._failure = self._failure or DockerError(sentence)
        return self._failure

    async def ask(self, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run the method `do` in a thread, and return its result."""
        return await self.in_thread(partial(self.do, what, call, *args, **kwargs))

    async def in_thread(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a function in a thread. If the waiting task is cancelled, the function continues in the thread, and
        `settle` waits for it.
        """
        future = self._threads.submit(partial(call, *args, **kwargs))
        self._pending.add(future)
        future.add_done_callback(self._pending.discard)
        return await asyncio.wrap_future(future)

    async def settle(self) -> None:
        """Wait for all calls to end, including those of cancelled tasks."""
        await asyncio.to_thread(concurrent.futures.wait, set(self._pending))

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        self.api.close()


class DockerEvents:
    """A reader for Docker's messages about all containers with a given label. The messages come in order."""

    def __init__(
        self,
        engine: DockerEngine,
        label: str,
        on_event: Callable[[dict[str, Any]], None],
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        """Start to read Docker's messages. `on_event` is called with each message. It is called with an empty message
        when the stream ends.
        """
        filters = {"type": "container", "label": label}
        self._stream = engine.do("events", engine.api.events, since=int(time.time()) - 1, filters=filters, decode=True)
        self._on_event = on_event
        self._loop = loop
        self._closed = False
        threading.Thread(target=self._follow, name="docker events", daemon=True).start()

    def _follow(self) -> None:
        with suppress(Exception):  # the SDK may raise anything when the connection ends
            for event in self._stream:
                self._emit(event)
        self._emit({})

    def _emit(self, event: dict[str, Any]) -> None:
        if not self._closed:
            self._loop.call_soon_threadsafe(self._on_event, event)

    def close(self) -> None:
        self._closed = True
        self._stream.close()


def _check_socket(path: str) -> None:
    """Raise DockerError with the reason if no program answers at the socket."""
    try:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(GREETING_LIMIT_S)
            connection.connect(path)
    except FileNotFoundError:
        raise DockerError(
            f"there is no Docker engine: {path} does not exist; install it (Debian, Ubuntu: apt install docker.io) and "
            f"start it (systemctl start docker)"
        ) from None
    except ConnectionRefusedError:
        raise DockerError(
            f"the Docker engine is not running: no process listens at {path}; start it (systemctl start docker)"
        ) from None
    except PermissionError:
        raise DockerError(f"{path} is not accessible to this user: use sudo") from None
    except OSError as error:
        raise DockerError(f"the Docker engine cannot be reached at {path}: {error.strerror or error}") from None
