"""Test the lab's end of the connection to a worker that sends malformed messages."""

import asyncio
import json
import signal
import socket
from pathlib import Path

import pytest

from harness.play.hosts._worker_connection import FarVehicle, WorkerConnection
from harness.play.remote._far_ends import FarEnd
from harness.play.remote._wire import NUMBER_BYTES, Channel, Kind

KEY, OTHER_KEY = b"a" * 32, b"b" * 32
FIRST = (1).to_bytes(NUMBER_BYTES, "big")


@pytest.mark.parametrize(
    ("kind", "payload", "reason"),
    [
        (Kind.READY, b"[1]", "a message READY is not a JSON object"),
        (Kind.READY, b"{}", "a message READY has no 'program' of the type int"),
        (Kind.READY, b'{"program": 7}', "a message names an unknown vehicle program"),
        (Kind.EXIT, b'{"program": "1"}', "a message EXIT has no 'program' of the type int"),
        (Kind.ANSWER, b'{"stream": []}', "a message ANSWER has no 'stream' of the type int"),
        (Kind.FILE, FIRST, "a message FILE is too short"),
        (Kind.FILE, FIRST + b"\0\4../x", "'../x' is not the name of a file"),
        (Kind.BEGIN, b"{}", "a message BEGIN arrived at the wrong time"),
    ],
)
def test_malformed_message_ends_the_connection_with_a_sentence(
    kind: Kind, payload: bytes, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle = asyncio.run(receive(tmp_path, [(kind, payload)]))
    assert capsys.readouterr().err == f"the connection ends: {reason}\n"
    assert vehicle.returncode == -signal.SIGKILL


def test_second_ready_ends_the_connection_with_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asyncio.run(receive(tmp_path, [(Kind.READY, b'{"program": 1}')] * 2))
    assert capsys.readouterr().err == "the connection ends: a vehicle program has started twice\n"


def test_status_of_another_type_counts_as_killed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ready, end = b'{"program": 1}', json.dumps({"program": 1, "status": "0"}).encode()
    vehicle = asyncio.run(receive(tmp_path, [(Kind.READY, ready), (Kind.EXIT, end)]))
    assert capsys.readouterr().err == ""
    assert vehicle.returncode == -signal.SIGKILL


async def receive(directory: Path, messages: list[tuple[Kind, bytes]]) -> FarVehicle:
    """Start a vehicle on a worker that sends these messages and ends. Return the vehicle."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    channel, other = Channel(KEY, OTHER_KEY), Channel(OTHER_KEY, KEY)
    connection = WorkerConnection("tcp://worker", lambda line: None)
    await connection.open(FarEnd(0, "session", [], "worker", ours, channel))
    (directory / "vehicle").mkdir()
    starts = asyncio.create_task(
        connection.start(1, ["program"], directory / "vehicle", directory / "vehicle" / "output.log")
    )
    await asyncio.sleep(0)
    vehicle = connection._programs[1]
    theirs.sendall(b"".join(other.encode(kind, payload) for kind, payload in messages))
    await asyncio.gather(starts, return_exceptions=True)
    await vehicle.wait()
    theirs.close()
    connection.close()
    return vehicle
