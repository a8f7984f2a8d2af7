"""The container engine, through the docker SDK: calls in threads, each with a time limit, and errors in one sentence.

An engine that does not answer once is not asked again: what waits for it would wait that long every time.
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
"""Calls at the same time; more of them make no machine faster."""

P = ParamSpec("P")
T = TypeVar("T")


class DockerError(MachineError, LabError):
    """The container engine cannot do what was asked, or is not there."""


class Engine:
    """`api` is the SDK's; ask it through `do`, or `ask` where others must not wait."""

    def __init__(self, api: docker.APIClient) -> None:
        self.api = api
        self._threads = ThreadPoolExecutor(AT_ONCE, "docker")
        self._under_way: set[Future[Any]] = set()
        self._gone: DockerError | None = None

    @classmethod
    def connect(cls) -> "Engine":
        """The engine of this machine. Raises DockerError."""
        host = os.environ.get("DOCKER_HOST") or DEFAULT_HOST
        if not host.startswith("unix://"):
            raise DockerError(
                f"DOCKER_HOST is {host}: the harness connects only containers on this machine to a network: unset it, "
                "or name the socket of a local engine (unix://...)"
            )
        _knock(host.removeprefix("unix://"))
        try:
            api = docker.APIClient(host, version="auto", timeout=round(GREETING_LIMIT_S))
        except docker.errors.DockerException as error:
            raise DockerError(
                f"the Docker engine at {host} does not answer: restart it (systemctl restart docker) ({error})"
            ) from None
        api.timeout = round(ANSWER_LIMIT_S)
        return cls(api)

    def do(self, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call the SDK; `what` names it in an error. Raises DockerError, or the SDK's APIError if it is refused."""
        if self._gone is not None:
            raise self._gone
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
        """It is gone: whoever asks it hears of the first reason, which is returned."""
        self._gone = self._gone or DockerError(sentence)
        return self._gone

    async def ask(self, what: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """As `do`, in a thread."""
        return await self.in_thread(partial(self.do, what, call, *args, **kwargs))

    async def in_thread(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Something that speaks to the engine. It goes on if whoever waits for it is cancelled: see `settle`."""
        future = self._threads.submit(partial(call, *args, **kwargs))
        self._under_way.add(future)
        future.add_done_callback(self._under_way.discard)
        return await asyncio.wrap_future(future)

    async def settle(self) -> None:
        """Wait until nothing is under way that nobody waits for any more."""
        await asyncio.to_thread(concurrent.futures.wait, set(self._under_way))

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        self.api.close()


class Events:
    """What the engine says of containers with a label, from now on, in the order in which it happens."""

    def __init__(
        self, engine: Engine, label: str, take: Callable[[dict[str, Any]], None], loop: asyncio.AbstractEventLoop
    ) -> None:
        """`take` is called in the loop; with an empty event when the engine ends them."""
        filters = {"type": "container", "label": label}
        self._stream = engine.do("events", engine.api.events, since=int(time.time()) - 1, filters=filters, decode=True)
        self._take = take
        self._loop = loop
        self._closed = False
        threading.Thread(target=self._follow, name="docker events", daemon=True).start()

    def _follow(self) -> None:
        with suppress(Exception):  # whatever the SDK makes of a connection that breaks, or that we close
            for event in self._stream:
                self._tell(event)
        self._tell({})

    def _tell(self, event: dict[str, Any]) -> None:
        if not self._closed:
            self._loop.call_soon_threadsafe(self._take, event)

    def close(self) -> None:
        self._closed = True
        self._stream.close()


def _knock(path: str) -> None:
    """Raises DockerError if nobody answers the door, and why."""
    try:
        with socket.socket(socket.AF_UNIX) as door:
            door.settimeout(GREETING_LIMIT_S)
            door.connect(path)
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
