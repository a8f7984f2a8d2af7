"""Test the stand-in of a remote agent without a lab. The test acts as the harness and as the far computer."""

import asyncio
import json
import os
import signal
import socket
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, cast

import pytest

from harness.archive.directory import RunDirectory
from harness.errors import AgentFailedError, MachineError
from harness.play.process._agent_process import AgentProcess
from harness.play.remote._connection import Connection
from harness.play.remote._far_clock import pong
from harness.play.remote._far_ends import FarEnds
from harness.play.remote._remote_agents import RemoteAgents
from harness.play.remote._stand_in_task import StandInTask
from harness.play.remote._wire import Channel, Kind, Message, hand_over
from harness.play.remote.agent_pool import AgentPool, RemoteIncarnation
from harness.play.remote.far_worker import MAX_UNSENT_BYTES, FarWorker, FileTail
from harness.play.remote.stand_in import StandIn
from harness.play.unix_sockets import bind_path
from harness.scenario.load import parse

DEADLINE_S = 10.0
MISSION = b'{"epoch_us": 1000000}'


class FarEnd:
    """One connection to the stand-in. The test controls the other end of the connection."""

    def __init__(self, harness: socket.socket) -> None:
        self._own, other = socket.socketpair()
        self._own.setblocking(False)
        other.setblocking(False)
        self._channel = Channel(b"a" * 32, b"b" * 32)
        self._messages: list[Message] = []
        self.datagrams = 0
        hand_over(harness, other, {**Channel(b"b" * 32, b"a" * 32).to_json(), "offset_s": None})

    def send(self, kind: Kind, payload: bytes = b"") -> None:
        self._own.sendall(self._channel.encode(kind, payload))

    async def receive(self, kind: Kind) -> dict[str, Any]:
        """Answer pings until a message of this kind arrives, and return its document."""
        loop = asyncio.get_running_loop()
        while True:
            while self._messages:
                message = self._messages.pop(0)
                if message.kind is kind:
                    return message.document()
                assert message.kind is Kind.PING
                self.send(Kind.PONG, pong(message.payload, self.datagrams))
            self._messages += self._channel.decode(await loop.sock_recv(self._own, 65536))

    def close(self) -> None:
        self._own.close()


@asynccontextmanager
async def stand_in(directory: Path) -> AsyncIterator[tuple[socket.socket, "asyncio.Task[int]"]]:
    """Run a stand-in. Return the socket of the harness, and the task that returns the exit status."""
    harness, inside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with harness, inside:
        inside.setblocking(False)
        harness.setblocking(False)
        task = StandInTask(2, 2, 2, 4200, 1.0, measures_lag=False)
        running = asyncio.create_task(StandIn(inside, task, MISSION, directory).run())
        async with asyncio.timeout(DEADLINE_S):
            yield harness, running
        running.cancel()


def reported(harness: socket.socket) -> list[dict[str, Any]]:
    """Return the messages that the harness has received from the stand-in."""
    messages = []
    while True:
        try:
            messages.append(json.loads(harness.recv(4096)))
        except BlockingIOError:
            return messages


def play(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(test())


def test_datagrams_lost_after_the_last_pong_are_counted(tmp_path: Path) -> None:
    async def lose() -> None:
        async with stand_in(tmp_path) as (harness, running):
            far = FarEnd(harness)
            await far.receive(Kind.BEGIN)
            far.send(Kind.TRACE, b"{}\n")
            far.send(Kind.EXIT, json.dumps({"status": -signal.SIGKILL, "left_behind": [], "datagrams": 3}).encode())
            assert await running == -signal.SIGKILL
            assert reported(harness)[-1]["lost"] == 3

    play(lose)


def test_datagrams_of_an_earlier_incarnation_are_not_counted(tmp_path: Path) -> None:
    async def lose() -> None:
        async with stand_in(tmp_path) as (harness, running):
            far = FarEnd(harness)
            far.datagrams = 50
            await far.receive(Kind.BEGIN)
            far.close()
            far = FarEnd(harness)
            await far.receive(Kind.BEGIN)
            far.send(Kind.EXIT, json.dumps({"status": 0, "left_behind": [], "datagrams": 0}).encode())
            assert await running == 0
            assert {message.get("lost", 0) for message in reported(harness)} == {0}

    play(lose)


def test_far_end_that_ends_an_earlier_incarnation_begins_again(tmp_path: Path) -> None:
    """The far end runs an incarnation that the lab killed. It ends this incarnation, and connects again."""

    async def begin() -> None:
        async with stand_in(tmp_path) as (harness, _):
            far = FarEnd(harness)
            first = await far.receive(Kind.BEGIN)
            far.close()
            far = FarEnd(harness)
            assert await far.receive(Kind.BEGIN) == first

    play(begin)


def test_far_computer_that_lost_its_agent_is_reported(tmp_path: Path) -> None:
    async def resume() -> None:
        async with stand_in(tmp_path) as (harness, running):
            far = FarEnd(harness)
            await far.receive(Kind.BEGIN)
            far.send(Kind.TRACE, b"{}\n")
            while not (tmp_path / "2.trace.jsonl").read_bytes():
                await asyncio.sleep(0.01)
            far.close()
            far = FarEnd(harness)
            assert (await far.receive(Kind.RESUME))["positions"]["TRACE"] == 3
            far.send(Kind.EXIT, b'{"gone": true}')
            assert await running == 1
            assert {"gone": True} in reported(harness)

    play(resume)


def test_signal_at_the_end_does_not_replace_the_status_of_the_agent(tmp_path: Path) -> None:
    (tmp_path / "2.mission.json").write_bytes(MISSION)

    async def end() -> None:
        task = StandInTask(2, 2, 2, 4200, 1.0, measures_lag=False)
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            bind_path(listener, tmp_path / "join")
            listener.listen(1)
            command = [*task.command(tmp_path / "join"), "2.mission.json"]
            program = await asyncio.create_subprocess_exec(*command, cwd=tmp_path)
            harness, _ = listener.accept()
        with harness:
            far = FarEnd(harness)
            await far.receive(Kind.BEGIN)
            far.send(Kind.EXIT, json.dumps({"status": 0, "left_behind": [], "datagrams": 0}).encode())
            while program.returncode is None:
                with suppress(ProcessLookupError):  # it has ended, and the loop does not know yet
                    os.kill(program.pid, signal.SIGTERM)  # `send_signal` would take the exit status from the loop
                await asyncio.sleep(0.001)
        assert program.returncode == 0

    play(end)


def test_harness_reads_all_messages_of_a_stand_in_at_once(tmp_path: Path) -> None:
    """A busy harness finds the start of the mission and the answer to its request at the same time."""

    async def hear() -> None:
        pool = AgentPool(2, "127.0.0.1:0", b"s" * 32)
        incarnation = RemoteIncarnation(pool, 2, 2, 4200, 1.0)
        inside, outside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with inside, outside:
            inside.setblocking(False)
            for message in ({"lost": 0}, {"offset_s": 1.5}, {"epoch_us": 7}):
                outside.send(json.dumps(message).encode())
            FarEnds(pool, "test")._hear(0, inside)
        assert incarnation.epoch_us == 7

    play(hear)


def test_losses_of_all_incarnations_are_added(tmp_path: Path) -> None:
    remote = {"agents": [2], "secret_file": "none"}
    scenario = parse({"name": "lost", "agents": 2, "vehicles": {"kind": "none"}, "remote": remote})
    agents = RemoteAgents(scenario, RunDirectory(tmp_path / "run"), lambda: 0.0)
    for lost, is_complete in ((3, True), (4, False), (2, True)):
        stand_in, other = socket.socketpair()
        with stand_in, other:
            agents.begin(2, stand_in)
            agents.hear(2, stand_in, {"lost": lost - 1})
            if is_complete:
                agents.hear(2, stand_in, {"left_behind": []})
            agents.hear(2, stand_in, {"lost": lost})
            agents.hear(2, stand_in, {})
    record = agents.records()["2"]
    assert (record.lost, record.incomplete) == (9, [2])
    assert record.lack == "the end of incarnation 2 is not on record, because the vehicle was cut off"


class SlowConnection:
    """A connection that has not sent its earlier messages yet."""

    unsent = MAX_UNSENT_BYTES + 1

    def __init__(self) -> None:
        self.sent: list[tuple[Kind, bytes]] = []

    def send(self, kind: Kind, payload: bytes) -> None:
        self.sent.append((kind, payload))


def test_whole_trace_is_sent_before_the_end_on_a_slow_connection(tmp_path: Path) -> None:
    (tmp_path / "trace").write_bytes(b"x" * 3_000_000)

    async def end() -> None:
        inside, outside = socket.socketpair()
        with inside, outside:
            worker = FarWorker(inside, tmp_path, [])
            connection = SlowConnection()
            worker._connection, worker._in_step = cast("Connection", connection), True
            worker._tails = {Kind.TRACE: FileTail(tmp_path / "trace")}
            worker._end({"status": 0, "left_behind": []})
        *lines, (last, _) = connection.sent
        assert b"".join(data for _, data in lines) == b"x" * 3_000_000
        assert last is Kind.EXIT

    play(end)


@pytest.mark.parametrize(("loss", "error"), [(None, AgentFailedError), ("cannot go on", MachineError)])
def test_agent_on_a_lost_computer_has_not_failed(tmp_path: Path, loss: str | None, error: type[Exception]) -> None:
    rundir = RunDirectory(tmp_path / "run")
    agent = AgentProcess(2, rundir, ["stand-in"], lambda: 0.0, loss=lambda: loss)
    agent._begin_incarnation()
    assert isinstance(agent._failure("hung", "did not answer"), error)
    assert agent.outcome == ("hung" if loss is None else "not exported")
