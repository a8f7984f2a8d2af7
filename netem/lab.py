"""Run programs in a virtual network (lab): vehicles in network namespaces, connected to one switch named `air`.

    async with await Lab.open([1, 2, 3], log=run_dir / "lab.log") as lab:
        agent = await lab.spawn(1, ["my-agent"], cwd=..., env=..., stdout=..., stderr=...)
        await lab.apply(NetworkConditions(LinkConditions(loss=0.15)))

The lab is not visible from outside. It adds no interface, rule or name to the caller's network. Files and Unix sockets
are shared with the caller. The lab ends with `close`, or with the caller's process. Process IDs belong to the lab, so
`LabProcess.pid` has no meaning outside.

Open a lab in the main thread. The kernel sends the lab a death signal when the thread that opened the lab ends (see
`netem._namespaces`). A lab that was opened in another thread therefore requests no death signal. Such a lab ends only
when the control socket is closed. If the lab is suspended with SIGSTOP, it does not detect this.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from netem import _namespaces, addresses
from netem._lab_channel import LabConnection
from netem._udp_counters import UdpCounters
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions
from netem.errors import ConditionsError, LabError, LabUnavailable, SpawnError

EngineName = Literal["netem", "nftables"]

_REMEDIES: dict[EngineName, str] = {
    "netem": "Use a kernel with sch_netem, sch_htb, sch_ingress, cls_basic, cls_fw, act_skbedit and act_gact (Debian: "
    "linux-image-amd64; Ubuntu: linux-modules-extra-$(uname -r); Fedora, RHEL: kernel-modules-extra; Arch: every "
    "kernel; Alpine: linux-lts; WSL2: a kernel of your own, with CONFIG_NET_SCH_NETEM), or run it "
    "inside User Mode Linux: --kernel uml.",
    "nftables": "Install nftables (apt install nftables), on a kernel with nf_tables for bridges and nft_numgen.",
}
_OPEN_DEADLINE_S = 60.0
_CLOSE_DEADLINE_S = 5.0


class RunningProgram(ABC):
    """A program that runs. Other code can wait for its end, and control it with signals. Subclasses implement
    `send_signal`, because the way to send a signal depends on the place where the program runs.
    """

    left_behind: tuple[str, ...] = ()
    """Names of child processes that ended with the program. Always empty, because only containers know these names."""

    def __init__(self, ended: asyncio.Future[int]) -> None:
        self._ended = ended

    @property
    def returncode(self) -> int | None:
        """The exit status of the program, or the negative number of the signal that killed it. None while the program
        runs.
        """
        return self._ended.result() if self._ended.done() else None

    @property
    def end(self) -> str:
        """A text about the end of the program: the name of the signal that killed it, or its exit status."""
        return in_words(self._ended.result())

    async def wait(self) -> int:
        """Wait until the program ends, and return the return code. If the network or the computer of the program ended
        together with it, the return code is -SIGKILL.
        """
        return await asyncio.shield(self._ended)

    @abstractmethod
    async def send_signal(self, number: int) -> None:
        """Send a signal to the program and its child processes. Do nothing if the program has ended."""

    async def pause(self) -> None:
        """Suspend the program with SIGSTOP until `resume` is called."""
        await self.send_signal(signal.SIGSTOP)

    async def resume(self) -> None:
        await self.send_signal(signal.SIGCONT)

    async def terminate(self, grace_s: float) -> int:
        """End the program with SIGTERM, or with SIGKILL after `grace_s` seconds. Return its return code."""
        await self.send_signal(signal.SIGTERM)
        await self.resume()  # a stopped process cannot react to SIGTERM
        try:
            return await asyncio.wait_for(self.wait(), grace_s)
        except TimeoutError:
            await self.send_signal(signal.SIGKILL)
            return await self.wait()


class LabProcess(RunningProgram):
    """A program in the virtual network. The program ends at the latest when the network is closed."""

    def __init__(self, channel: LabConnection, vehicle: int | None, pid: int, ended: asyncio.Future[int]) -> None:
        super().__init__(ended)
        self._channel = channel
        self.vehicle = vehicle
        self.pid = pid

    async def send_signal(self, number: int) -> None:
        if not self._ended.done():
            await self._channel.ask("signal", pid=self.pid, signal=int(number))


class Lab:
    """A private network of real processes, in Linux namespaces. Create it with `Lab.open`."""

    def __init__(self, vehicles: tuple[int, ...], process: asyncio.subprocess.Process, channel: LabConnection) -> None:
        self._process = process
        self._channel = channel
        self.vehicles = vehicles
        self.addresses = {vehicle: addresses.address(vehicle) for vehicle in vehicles}
        self.broadcast = addresses.BROADCAST
        self.engine = ""
        self.engine_reason = ""
        self.networks: dict[int, int] = {}
        """Vehicle -> inode number of its network namespace, as in /proc/PID/ns/net."""

    @classmethod
    async def open(
        cls,
        vehicles: Sequence[int],
        *,
        engine: EngineName | None = None,
        needs: Sequence[str] = (),
        networks: Mapping[int, int] | None = None,
        log: Path,
    ) -> Lab:
        """Open a virtual network for these vehicle IDs, 1 to 65535. The output of its first process goes to `log`.

        `engine` is the engine to use; by default the lab chooses one. `needs` lists the conditions other than loss and
        partition that the engine must support (`NetworkConditions.needs`). `networks` maps vehicles to file descriptors
        of existing network namespaces. Only root may use this argument. The caller closes the descriptors. Raises
        LabUnavailable if this machine cannot run a lab, or has no engine for these needs.
        """
        ids = _checked(vehicles)
        namespaces = dict(networks or {})
        message = ""
        for user_namespace in (False,) if namespaces else _namespaces.user_namespace_choices():
            lab = await cls._enter(ids, user_namespace, namespaces, log)
            try:
                refusal = await asyncio.wait_for(lab._start(engine, needs, namespaces, log), _OPEN_DEADLINE_S)
            except TimeoutError:
                await lab.close()
                raise LabError(f"The lab was not up within {_OPEN_DEADLINE_S:g} s; see {log}") from None
            except BaseException:
                await lab.close()
                raise
            if refusal is None:
                return lab
            message = refusal
        if (failure := _namespaces.not_executed(message)) is not None:
            program, why = failure
            reason = f"{_namespaces.user()} cannot execute {program} ({why})"
            raise LabUnavailable(f"The lab's first process cannot be started: {reason}", _namespaces.way_out(message))
        raise LabUnavailable(
            f"This machine does not allow private networks ({message})",
            f"{_namespaces.way_out(message)} Or run it inside User Mode Linux: --kernel uml.",
        )

    @classmethod
    async def _enter(
        cls, vehicles: tuple[int, ...], user_namespace: bool, networks: Mapping[int, int], log: Path
    ) -> Lab:
        own_end, lab_end = socket.socketpair()
        argv = _namespaces.command(
            [sys.executable, "-P", "-m", "netem.init", str(lab_end.fileno())],
            user_namespace=user_namespace,
            die_with_parent=threading.current_thread() is threading.main_thread(),
        )
        # The lab's first process imports the same package as this one. Programs in the lab have their own environment.
        path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]))
        try:
            with lab_end, log.open("ab") as output:
                process = await asyncio.create_subprocess_exec(
                    *argv,
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    env={**os.environ, "PYTHONPATH": path, "LC_ALL": "C.UTF-8"},  # tools print English messages
                    pass_fds=[lab_end.fileno(), *networks.values()],
                    start_new_session=True,  # Ctrl-C in the terminal reaches only the orchestrator
                )
        except FileNotFoundError as error:
            own_end.close()
            message = f"{error.filename} is not installed"
            raise LabUnavailable(message, _namespaces.way_out(message)) from None
        except BaseException:
            own_end.close()
            raise
        return cls(vehicles, process, LabConnection(own_end, log))

    async def _start(
        self, engine: EngineName | None, needs: Sequence[str], networks: Mapping[int, int], log: Path
    ) -> str | None:
        """Build the network. Return None on success.

        If the kernel refuses new namespaces, return the error message of `unshare` or `setpriv`.
        """
        if not await self._channel.inside():
            await self.close()
            message = _last_line(log)
            if message.startswith(("unshare:", "setpriv:")):
                return message
            raise LabError(f"The lab's first process ended before it began ({message}); see {log}")
        try:
            result, _ = await self._channel.ask(
                "open", vehicles=self.vehicles, engine=engine, needs=[*needs], networks={**networks}
            )
        except LabError as error:
            if not self._channel.open:
                raise
            raise LabUnavailable(
                f"This kernel does not build the lab's network ({error})",
                "It needs bridges and veth pairs; as root: modprobe -a bridge veth.",
                "fabric",
            ) from error
        if result["engine"] is None:
            wanted = [_REMEDIES[engine]] if engine else [_REMEDIES["netem"]] if needs else [*_REMEDIES.values()]
            if needs:
                wanted.append("play it in virtual time: --backend sim.")
            work = f"No engine {engine} works" if engine else "No engine at all works"
            reason = f"Nothing does {', '.join(needs)}" if needs else work
            raise LabUnavailable(f"{reason} here ({result['reason']})", " Or: ".join(wanted), "engine")
        self.engine = result["engine"]
        self.engine_reason = result["reason"]
        self.networks = {int(vehicle): inode for vehicle, inode in result["networks"].items()}
        return None

    @property
    def network(self) -> Self:
        """This virtual network itself. The property exists because the class for containers has a property of the same
        name, which returns the virtual network between its containers.
        """
        return self

    async def spawn(
        self,
        vehicle: int | None,
        argv: Sequence[str],
        *,
        cwd: Path,
        env: Mapping[str, str],
        stdout: Path,
        stderr: Path,
        role: str = "program",
        max_file_bytes: int | None = None,
        fork: bool = False,
    ) -> LabProcess:
        """Start a program in the network of a vehicle.

        If `vehicle` is None, the program runs in the lab's own network, which no vehicle can reach.

        `env` is its whole environment. Its output is appended to the files `stdout` and `stderr`. Its input is empty.
        `role` names the program in errors. The program cannot make a file larger than `max_file_bytes`: a write beyond
        this size fails with EFBIG. If `fork` is true, the module runs in a fork of the lab's first process, because a
        fork starts faster than a new interpreter. The command must then be `python -P -m MODULE ...` with this
        interpreter. Raises SpawnError with the message of the operating system.
        """
        self._check_vehicle(vehicle)
        where = {"cwd": str(cwd), "stdout": str(stdout), "stderr": str(stderr), "max_file_bytes": max_file_bytes}
        try:
            result, _ = await self._channel.ask("spawn", vehicle=vehicle, argv=[*argv], env={**env}, fork=fork, **where)
        except SpawnError as error:
            raise SpawnError(f"The {role} cannot be started: {error}") from None
        return LabProcess(self._channel, vehicle, result["pid"], result["ended"])

    async def connect(self, vehicle: int, port: int, *, host: str = "127.0.0.1", timeout_s: float) -> socket.socket:
        """Open a TCP connection inside the network of a vehicle, and return the socket. `host` is a numeric address.

        Raises ConnectionError if no program listens there, and TimeoutError after `timeout_s` seconds.
        """
        self._check_vehicle(vehicle)
        try:
            socket.inet_pton(socket.AF_INET, host)
        except OSError:
            raise LabError(f"host: {host!r} is not a numeric IPv4 address; a lab has no names") from None
        _, connection = await self._channel.ask("connect", vehicle=vehicle, host=host, port=port, timeout_s=timeout_s)
        if connection is None:
            raise LabError(f"The lab made no connection to {host}:{port} of vehicle {vehicle}")
        connection.setblocking(True)
        return connection

    async def apply(self, conditions: NetworkConditions) -> AppliedConditions:
        """Apply network conditions, and return the state that the kernel reports afterwards.

        Raises ConditionsError for a vehicle that does not exist, EngineError if the kernel refuses.
        """
        conditions.validate(self.vehicles)
        result, _ = await self._channel.ask("apply", conditions=conditions.to_json())
        return AppliedConditions.from_json(result)

    async def read(self) -> AppliedConditions:
        """Return the network conditions and packet counters that the kernel reports."""
        result, _ = await self._channel.ask("read")
        return AppliedConditions.from_json(result)

    async def datagrams(self) -> dict[int, UdpCounters]:
        """Return the counts of UDP datagrams in the network of each vehicle."""
        result, _ = await self._channel.ask("datagrams")
        return {int(vehicle): UdpCounters(**counted) for vehicle, counted in result.items()}

    async def watch(self) -> None:
        """Wait until the virtual network fails, then raise LabError."""
        await self._process.wait()
        raise LabError("The lab's first process ended unexpectedly")

    async def close(self) -> None:
        """End all programs in the network, and remove it. A second call does nothing."""
        self._channel.close()
        try:
            await asyncio.wait_for(self._process.wait(), _CLOSE_DEADLINE_S)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):  # the process may end at this moment
                self._process.kill()
            await self._process.wait()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def _check_vehicle(self, vehicle: int | None) -> None:
        if vehicle is not None and vehicle not in self.addresses:
            allowed = ", ".join(map(str, self.vehicles))
            raise LabError(f"vehicle: the lab has no vehicle {vehicle!r}; use one of {allowed}")


def _checked(vehicles: Sequence[int]) -> tuple[int, ...]:
    ids = tuple(vehicles)
    for vehicle in ids:
        if isinstance(vehicle, bool) or not isinstance(vehicle, int) or not 1 <= vehicle <= addresses.MAX_ID:
            raise ConditionsError(f"vehicles: {vehicle!r} is not a vehicle ID; allowed is 1..{addresses.MAX_ID}")
    if not ids or len(set(ids)) != len(ids):
        raise ConditionsError(f"vehicles: {list(ids)} must name each vehicle once, and at least one")
    return ids


def in_words(returncode: int) -> str:
    """Describe how a process ended, such as "SIGKILL" or "status 3"."""
    if returncode >= 0:
        return f"status {returncode}"
    number = -returncode
    return signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"  # real-time ones


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"


__all__ = ["EngineName", "Lab", "LabError", "LabProcess", "LabUnavailable", "RunningProgram", "UdpCounters", "in_words"]
