"""Test messages, handshake and clock of a connection to another computer, without a lab."""

import asyncio
import json
import os
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from harness.archive.directory import RunDirectory
from harness.play.remote import _far_clock, _remote_agents, join
from harness.play.remote._far_clock import FarClock, ping, pong
from harness.play.remote._far_ends import FarEnd, FarEnds
from harness.play.remote._handshake import (
    MAX_TEXT_BYTES,
    PROTOCOL,
    HandshakeError,
    Hello,
    RefusedError,
    _shared,
    introduce,
    receive_hello,
)
from harness.play.remote._key_exchange import KeyExchange
from harness.play.remote._remote_agents import RemoteAgents
from harness.play.remote._wire import MAX_MESSAGE_BYTES, Channel, Kind, Message, WireError
from harness.play.remote.secret_file import SecretError, create_secret, read_secret
from harness.scenario.load import parse
from ucp.features import CONTRACT

KEY, OTHER_KEY = b"a" * 32, b"b" * 32
SECRET = b"s" * 32


def channels() -> tuple[Channel, Channel]:
    return Channel(KEY, OTHER_KEY), Channel(OTHER_KEY, KEY)


def test_messages_arrive_unchanged_in_any_pieces() -> None:
    sender, receiver = channels()
    data = sender.encode(Kind.TRACE, b"x" * 3000) + sender.encode(Kind.IDLE) + sender.encode(Kind.LOG, b"y")
    found: list[Message] = []
    for position in range(0, len(data), 7):
        found += receiver.decode(data[position : position + 7])
    assert found == [Message(Kind.TRACE, b"x" * 3000), Message(Kind.IDLE, b""), Message(Kind.LOG, b"y")]


def test_repeated_message_is_refused() -> None:
    sender, receiver = channels()
    data = sender.encode(Kind.DATAGRAM, b"vote")
    receiver.decode(data)
    with pytest.raises(WireError, match="not authentic"):
        receiver.decode(data)


def test_left_out_message_is_refused() -> None:
    sender, receiver = channels()
    sender.encode(Kind.DATAGRAM, b"first")
    with pytest.raises(WireError, match="not authentic"):
        receiver.decode(sender.encode(Kind.DATAGRAM, b"second"))


@pytest.mark.parametrize("position", [4, 5, 12, -1])
def test_changed_message_is_refused(position: int) -> None:
    sender, receiver = channels()
    data = bytearray(sender.encode(Kind.DATAGRAM, b"datagram"))
    data[position] ^= 1
    with pytest.raises(WireError, match="not authentic"):
        receiver.decode(bytes(data))


def test_message_of_the_own_direction_is_refused() -> None:
    """An attacker may send the messages of one end back to the same end."""
    sender, _ = channels()
    with pytest.raises(WireError, match="not authentic"):
        sender.decode(sender.encode(Kind.SIGNAL, b"{}"))


def test_endless_message_is_refused_at_its_header() -> None:
    _, receiver = channels()
    with pytest.raises(WireError, match="at most"):
        receiver.decode(struct.pack("!IB", MAX_MESSAGE_BYTES + 1, Kind.TRACE))


def test_another_process_continues_a_channel() -> None:
    sender, receiver = channels()
    receiver.decode(sender.encode(Kind.PING))
    later_sender = Channel.from_json(json.loads(json.dumps(sender.to_json())))
    later_receiver = Channel.from_json(json.loads(json.dumps(receiver.to_json())))
    assert later_receiver.decode(later_sender.encode(Kind.PONG, b"1")) == [Message(Kind.PONG, b"1")]


# The handshake


def shake(lab_secret: bytes, far_secret: bytes, welcome: dict[str, Any]) -> Any:
    """Let two ends greet each other. Return the result or the error of each end."""

    async def lab(connection: socket.socket) -> Any:
        hello = await receive_hello(connection, lab_secret)
        return hello.words, await hello.answer(welcome)

    async def both() -> Any:
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            far.setblocking(False)
            asked = lab(near), introduce(far, far_secret, {"agent": 7})
            return await asyncio.gather(*asked, return_exceptions=True)

    return asyncio.run(both())


def test_ends_with_the_same_secret_get_matching_keys() -> None:
    (words, near), (far, welcome) = shake(SECRET, SECRET, {"run": "1"})
    assert (words, welcome) == ({"agent": 7}, {"run": "1"})
    assert far.decode(near.encode(Kind.IDLE)) == [Message(Kind.IDLE, b"")]
    assert near.decode(far.encode(Kind.READY)) == [Message(Kind.READY, b"")]


def test_each_connection_has_its_own_keys() -> None:
    (_, first), _ = shake(SECRET, SECRET, {})
    (_, second), _ = shake(SECRET, SECRET, {})
    assert first.to_json()["send_key"] != second.to_json()["send_key"]
    assert first.to_json()["send_key"] != first.to_json()["receive_key"]


def test_wrong_secret_is_reported_at_both_ends() -> None:
    near, far = shake(SECRET, b"t" * 32, {})
    assert isinstance(near, HandshakeError)
    assert isinstance(far, HandshakeError)
    assert "another secret" in str(near)
    assert "another secret" in str(far)


def test_harness_without_the_secret_cannot_welcome_an_agent() -> None:
    """A false harness accepts any hello, and sends a welcome with a wrong tag."""

    async def both() -> Any:
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            far.setblocking(False)
            near.send(b"UCPJOIN1" + bytes(32))
            welcome = json.dumps({"run": "1", "name": "false"}).encode()
            near.send(struct.pack("!H", len(welcome)) + welcome + bytes(32))
            return await introduce(far, SECRET, {"agent": 7})

    with pytest.raises(HandshakeError, match="another secret"):
        asyncio.run(both())


def test_refusal_reaches_the_far_end() -> None:
    _, far = shake(SECRET, SECRET, {"refused": "agent 7 is not awaited"})
    assert isinstance(far, RefusedError)
    assert str(far) == "agent 7 is not awaited"


@pytest.mark.parametrize("sent", [struct.pack("!H", MAX_TEXT_BYTES + 1), b"\0", b""])
def test_long_or_broken_hello_ends_the_handshake(sent: bytes) -> None:
    async def greet() -> None:
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            far.send(sent)
            far.shutdown(socket.SHUT_WR)
            await receive_hello(near, SECRET)

    with pytest.raises(HandshakeError):
        asyncio.run(greet())


# The clock


def test_offset_lies_within_its_uncertainty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A message takes three times as long in one direction as in the other. No measurement can detect this."""
    clock = FarClock()
    now = 100.0
    monkeypatch.setattr(_far_clock.time, "monotonic", lambda: now)
    monkeypatch.setattr(_far_clock.time, "time", lambda: 5000.0 + now)
    for _ in range(3):
        sent = ping()
        now += 0.010
        far_wall, far_monotonic = 5000.0 + now + 3600.0, now + 7.0
        answer = struct.pack("!dddQ", struct.unpack("!d", sent)[0], far_wall, far_monotonic, 4)
        now += 0.030
        assert clock.receive(answer) == 4
    assert clock.uncertainty_s == pytest.approx(0.020)
    assert abs(clock.offset_s - 3600.0) <= clock.uncertainty_s + 1e-9
    assert clock.delay_s == pytest.approx(0.020)
    assert clock.drift() is None


def test_drift_of_a_far_clock_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FarClock()
    now = 0.0
    monkeypatch.setattr(_far_clock.time, "monotonic", lambda: now)
    monkeypatch.setattr(_far_clock.time, "time", lambda: now)
    for _ in range(200):
        now += 0.5
        clock.receive(struct.pack("!dddQ", now, now, now * 1.001, 0))
    assert clock.drift() == pytest.approx(0.001, rel=0.01)


@pytest.mark.parametrize("payload", [b"", bytes(7), bytes(33)])
def test_malformed_ping_or_pong_is_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        pong(payload, 0)
    with pytest.raises(WireError):
        FarClock().receive(payload)


# The files of the far end


def test_files_of_a_killed_far_end_are_removed_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with join.directory_of_agents() as active:
        (tmp_path / "ucp-join-killed").mkdir()
        with join.directory_of_agents() as second:
            assert {*tmp_path.iterdir()} == {active, second, tmp_path / "ucp-join-killed"}, "it may be new"
        monkeypatch.setattr(join, "NEW_S", -1.0)
        with join.directory_of_agents() as third:
            assert {*tmp_path.iterdir()} == {active, third}
    assert [*tmp_path.iterdir()] == []


# The secret


def test_new_secret_can_be_read_by_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "lab.key"
    create_secret(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(read_secret(path)) == 32
    with pytest.raises(SecretError, match="never replaced"):
        create_secret(path)


def test_unusable_secret_files_are_refused_with_a_solution(tmp_path: Path) -> None:
    path = tmp_path / "lab.key"
    with pytest.raises(SecretError, match="--new-secret"):
        read_secret(path)
    create_secret(path)
    path.chmod(0o644)
    with pytest.raises(SecretError, match="chmod 600"):
        read_secret(path)
    for content in (b"00\n", b"zz" * 32, b"\xff" * 64):
        path.write_bytes(content)
        path.chmod(0o600)
        with pytest.raises(SecretError, match="--new-secret"):
            read_secret(path)
    path.unlink()
    os.mkfifo(path, 0o600)
    with pytest.raises(SecretError, match="is not a file"):
        read_secret(path)


# Encryption


def test_messages_on_the_connection_are_encrypted() -> None:
    (_, near), (far, _) = shake(SECRET, SECRET, {})
    assert near.is_encrypted and far.is_encrypted
    sent = near.encode(Kind.BEGIN, b"the keys of the mission")
    assert b"keys" not in sent
    assert far.decode(sent) == [Message(Kind.BEGIN, b"the keys of the mission")]


@pytest.mark.parametrize("position", [0, 4, 5, 12, -1])
def test_changed_encrypted_message_is_refused(position: int) -> None:
    (_, near), (far, _) = shake(SECRET, SECRET, {})
    data = bytearray(near.encode(Kind.REQUEST, b"1234 request"))
    data[position] ^= 1
    with pytest.raises(WireError):
        far.decode(bytes(data) + bytes(256))


def test_repeated_encrypted_message_is_refused() -> None:
    (_, near), (far, _) = shake(SECRET, SECRET, {})
    data = near.encode(Kind.IDLE)
    far.decode(data)
    with pytest.raises(WireError, match="not authentic"):
        far.decode(data)


def test_another_process_continues_an_encrypted_channel() -> None:
    (_, near), (far, _) = shake(SECRET, SECRET, {})
    far.decode(near.encode(Kind.IDLE))
    continued = Channel.from_json(json.loads(json.dumps(near.to_json())))
    assert far.decode(continued.encode(Kind.IDLE)) == [Message(Kind.IDLE, b"")]


def test_end_without_cryptography_has_no_encryption(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.asymmetric.x25519", None)
    (_, near), (far, _) = shake(SECRET, SECRET, {})
    assert not near.is_encrypted and not far.is_encrypted
    assert far.decode(near.encode(Kind.IDLE)) == [Message(Kind.IDLE, b"")]


def test_removed_public_key_ends_the_handshake() -> None:
    """An attacker between the ends replaces the public key in the hello by null."""

    async def relay(lab: socket.socket, far: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        await loop.sock_sendall(far, await loop.sock_recv(lab, 4096))
        hello = await loop.sock_recv(far, 4096)
        (length,) = struct.unpack_from("!H", hello)
        words = json.loads(hello[2 : 2 + length])
        assert words["share"] is not None
        text = json.dumps({**words, "share": None}).encode()
        await loop.sock_sendall(lab, struct.pack("!H", len(text)) + text + hello[2 + length :])

    async def both() -> Any:
        lab, lab_side = socket.socketpair()
        far, far_side = socket.socketpair()
        with lab, lab_side, far, far_side:
            for end in (lab, lab_side, far, far_side):
                end.setblocking(False)
            relaying = asyncio.create_task(relay(lab_side, far_side))
            asked = asyncio.create_task(introduce(far, SECRET, {"agent": 7}))
            try:
                await receive_hello(lab, SECRET)
            finally:
                asked.cancel()
                await asyncio.gather(asked, relaying, return_exceptions=True)

    with pytest.raises(HandshakeError, match="another secret"):
        asyncio.run(both())


def test_wrong_public_key_ends_the_handshake() -> None:
    for share in ("00" * 32, "ff", 7):  # the first has small order, so every attacker would know the result
        with pytest.raises(HandshakeError, match="wrong public key"):
            _shared(KeyExchange(), {"share": share})


def test_far_end_without_encryption_gets_no_keys() -> None:
    scenario = parse(
        {
            "name": "keys",
            "agents": 2,
            "vehicles": {"kind": "none"},
            "remote": {"agents": [2], "secret_file": "none"},
            "security": {"keys": "fresh"},
        }
    )
    host = RemoteAgents(scenario, cast("RunDirectory", None), lambda: 0.0)
    words = {"protocol": PROTOCOL, "contract": CONTRACT, "agent": 2, "session": "1", "command": ["a"]}
    with socket.socket() as connection:
        hello = Hello(words, connection, SECRET, b"", b"", KeyExchange(), None)
        refused = FarEnds(host, "keys", has_keys=True).refusal(hello, "192.168.7.2")
        assert "this mission has keys, which must travel encrypted" in refused
        sealed = Hello(words, connection, SECRET, b"", b"", KeyExchange(), bytes(32))
        assert FarEnds(host, "keys", has_keys=True).refusal(sealed, "192.168.7.2") == ""


def test_worker_connects_again_until_the_harness_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter([join.JoinError("does not answer"), join.JoinError("closed the connection"), "joined"])
    assert asyncio.run(connected(monkeypatch, answers)) == "joined"


@pytest.mark.parametrize("error", [join.JoinRefusedError("it has begun"), join.RunOverError("no harness listens")])
def test_worker_gives_up_if_it_is_refused_or_the_run_is_over(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(type(error)):
        asyncio.run(connected(monkeypatch, iter([join.JoinError("does not answer"), error])))


async def connected(monkeypatch: pytest.MonkeyPatch, answers: Iterator[Any]) -> Any:
    """Connect patiently to a harness that gives these answers, one for each attempt."""

    async def connect(request: join.JoinRequest, session: str) -> Any:
        assert session == "session", "the harness takes another session for another process"
        if isinstance(answer := next(answers), Exception):
            raise answer
        return answer

    monkeypatch.setattr(join, "connect", connect)
    monkeypatch.setattr(join, "RETRY_S", 0.0)
    request = join.JoinRequest("127.0.0.1", 1, 1, SECRET, [], service=False)
    return await join.connect_patiently(request, "session")


def test_refused_far_end_learns_the_reason(tmp_path: Path) -> None:
    scenario = parse(
        {"name": "refused", "agents": 2, "vehicles": {"kind": "none"}, "remote": {"agents": [2], "secret_file": "none"}}
    )

    async def both() -> None:
        listener = socket.create_server(("127.0.0.1", 0))
        listener.setblocking(False)
        port = listener.getsockname()[1]
        host = RemoteAgents(scenario, cast("RunDirectory", None), lambda: 0.0)
        async with FarEnds(host, "refused").opened([listener], SECRET, tmp_path):
            await join.connect(join.JoinRequest("127.0.0.1", port, 3, SECRET, [], service=False), "session")

    with pytest.raises(join.JoinRefusedError, match="this mission awaits agent 2, not agent 3"):
        asyncio.run(both())


def test_harness_measures_few_delays_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    agents = range(2, 50)
    remote = {"agents": [*agents], "secret_file": "none"}
    scenario = parse({"name": "many", "agents": 50, "vehicles": {"kind": "none"}, "remote": remote})
    measuring, most = 0, 0

    class SlowFarEnd(FarEnd):
        async def measured_delay(self) -> float:
            nonlocal measuring, most
            measuring += 1
            most = max(most, measuring)
            await asyncio.sleep(0)
            measuring -= 1
            return 0.001

        async def keep(self) -> None:
            pass

    async def receive() -> None:
        host = RemoteAgents(scenario, cast("RunDirectory", None), lambda: 0.0)
        with socket.socket() as connection:
            ends = [SlowFarEnd(agent, "session", [], "pi", connection, Channel(KEY, KEY)) for agent in agents]
            await asyncio.gather(*map(host.receive, ends))

    asyncio.run(receive())
    assert most == _remote_agents.MAX_MEASUREMENTS
