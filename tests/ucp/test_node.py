"""Test one agent as a process: its files, its control socket, and its reaction to errors."""

import asyncio
import base64
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pytest

from harness.archive.exports import read_export
from harness.archive.traces import read_trace
from harness.play.agent_control import AgentControl, AgentRefusedError, AgentSilentError
from ucp.agent_files import TraceFile
from ucp.block import Block, InceptionBlock, next_chain_hash
from ucp.messages import BlockAddRequest, CommitBlock, RequestForBlock, decode, encode
from ucp.mission import parse_mission
from ucp.node import Node
from ucp.store import Store
from ucp.trace import DroppedDatagram

DEADLINE_S = 10.0
NEEDED = {
    *("agent", "block", "chain", "clock", "commit", "control", "core", "_dataclass", "events", "export", "features"),
    *(
        "agent_files",
        "_answer_spread",
        "handler",
        "loop",
        "messages",
        "mission",
        "reconcile",
        "_request",
        "settings",
        "short_value",
        "state",
    ),
    *("_drop_quota", "plain_file", "sealed", "_status", "store", "timers", "trace", "trigger", "wire"),
}
"""The modules of `ucp` that every agent imports."""


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def mission(**changes: Any) -> dict[str, Any]:
    return {
        "schema": "ucp-mission/1",
        "agent_id": 7,
        "roster": [7, 9],
        "initial_data": base64.b64encode(b"test").decode(),
        "network": {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": free_port()},
        "events": {"source": "none"},
        "seed": 1,
        "speedup": 100,
        **changes,
    }


class AgentUnderTest:
    def __init__(self, directory: Path, document: dict[str, Any]) -> None:
        self.directory = directory
        self.document = document
        self.name = str(document["agent_id"])
        path = directory / f"{self.name}.mission.json"
        path.write_text(json.dumps(document))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ucp.node", str(path)], stderr=subprocess.PIPE, text=True
        )
        self.wait_for(lambda: (directory / f"{self.name}.control").exists() or self.process.poll() is not None)

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        async def ask() -> dict[str, Any]:
            control = AgentControl(self.directory / f"{self.name}.control")
            try:
                return await control.ask(command, timeout_s=DEADLINE_S, **arguments)
            finally:
                control.close()

        return asyncio.run(ask())

    def start(self) -> None:
        self.ask("start", epoch_us=round(time.time() * 1e6))

    def wait_for(self, condition: Any) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, "it never happened"
            time.sleep(0.005)

    def send(self, datagram: bytes) -> None:
        """Send a datagram to the agent from another address. The agent ignores datagrams from its own address."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind(("127.0.0.2", 0))
            sock.sendto(datagram, ("127.0.0.1", self.document["network"]["port"]))


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Return a directory whose path exceeds the maximum length of a Unix socket's path."""
    deep = tmp_path / ("d" * 100) / "agents"
    deep.mkdir(parents=True)
    return deep


@pytest.fixture
def agent(directory: Path) -> Iterator[AgentUnderTest]:
    agent = AgentUnderTest(directory, mission())
    yield agent
    agent.process.kill()
    agent.process.communicate()


def test_agent_waits_for_start_and_then_commits_and_exports_blocks(directory: Path) -> None:
    agent = AgentUnderTest(directory, mission(events={"source": "random", "mean_s": 1.0}))
    assert agent.ask("status")["started"] is False
    agent.start()
    agent.wait_for(lambda: agent.ask("status")["chain"] >= 3)
    agent.ask("stop_events")
    agent.wait_for(lambda: agent.ask("status")["idle"])
    agent.process.terminate()
    assert agent.process.wait(DEADLINE_S) == 0
    export = read_export(directory / "7.chain.json")
    assert len(export.chain) == len(export.completed) >= 3
    trace = read_trace(directory / "7.trace.jsonl")
    assert trace is not None and not trace.problem
    assert trace.completed() == export.completed
    assert trace.header.roster == [7, 9]
    assert sorted(path.name for path in directory.iterdir()) == [
        "7.chain.json",
        "7.log",
        "7.mission.json",
        "7.trace.jsonl",
    ]


def test_agent_imports_only_the_modules_that_it_needs(directory: Path) -> None:
    """Other modules would make the start slower and need memory."""
    loaded = modules_of(directory, mission(events={"source": "random"}))
    assert not loaded & {"asyncio", "logging", "ssl", "subprocess", "threading", "pymavlink", "scapy", "difflib"}
    assert not loaded & {"dataclasses", "inspect", "hashlib", "_hashlib"}
    ours = {name.removeprefix("ucp.") for name in loaded if name.startswith("ucp.")}
    assert ours == NEEDED


@pytest.mark.parametrize(
    ("asked", "module"),
    [({"quirks": {"ignore_commit": 0.5}}, "ucp.quirks"), ({"events": {"source": "mavlink"}}, "ucp.telemetry")],
)
def test_agent_imports_modules_for_the_features_of_its_mission(
    directory: Path, asked: dict[str, Any], module: str
) -> None:
    assert module in modules_of(directory, mission(**asked))


def test_agent_imports_mavlink_before_the_mission_starts(directory: Path) -> None:
    """The import needs half a second of processor time, in which the agent would not answer."""
    path = directory / "7.mission.json"
    path.write_text(json.dumps(mission(events={"source": "mavlink"})))
    process = subprocess.Popen([sys.executable, "-v", "-m", "ucp.node", str(path)], stderr=subprocess.PIPE, text=True)
    wait_for_text(directory / "7.log", "ready")
    process.terminate()
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert "import 'pymavlink.dialects.v20.common'" in errors


def wait_for_text(path: Path, text: str) -> None:
    """Wait until the file exists and contains the text."""
    deadline = time.monotonic() + DEADLINE_S
    while not path.exists() or text not in path.read_text():
        assert time.monotonic() < deadline, f"{path} never contained {text!r}"
        time.sleep(0.005)


def modules_of(directory: Path, document: dict[str, Any]) -> set[str]:
    """Play a short mission, and return the modules that the agent has imported at its end."""
    path = directory / "7.mission.json"
    path.write_text(json.dumps(document | {"epoch_us": round(time.time() * 1e6)}))
    command = [sys.executable, "-X", "importtime", "-m", "ucp.node", str(path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for_text(directory / "7.trace.jsonl", "\n")
    process.terminate()
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, errors
    return {line.rpartition("|")[2].strip() for line in errors.splitlines()}


def test_agent_exports_on_command_while_it_runs(agent: AgentUnderTest) -> None:
    assert agent.ask("export")["path"].endswith("7.chain.json")
    assert read_export(agent.directory / "7.chain.json").idle


def test_agent_answers_messages_and_counts_hostile_datagrams(agent: AgentUnderTest) -> None:
    agent.start()
    rng = Random(1)
    for sent in range(1, 201):
        agent.send(rng.randbytes(rng.randrange(1400)))
        if sent % 20 == 0:  # a socket's buffer is finite, and a machine may be slow
            agent.wait_for(lambda sent=sent: sum(agent.ask("status")["dropped"].values()) == sent)
    agent.send(encode(7, 0, RequestForBlock(bytes(32))))
    agent.send(encode(8, 0, RequestForBlock(bytes(32))))
    agent.send(encode(9, 0, RequestForBlock(Block(9, 1, b"x").block_hash)))
    agent.wait_for(lambda: agent.ask("status")["received"] == {"Request for Block": 1})
    status = agent.ask("status")
    assert status["dropped"]["own sender"] == 1
    assert status["dropped"]["sender not on the roster"] == 1
    assert status["handled"] == 1


def test_commands_set_quirks_and_start_reconciles(agent: AgentUnderTest) -> None:
    agent.start()
    assert agent.ask("quirk", name="ignore_commit", value=0.5)["ignore_commit"] == 0.5
    agent.ask("reconcile")
    agent.wait_for(lambda: agent.ask("status")["reconciles"] == 1)
    agent.wait_for(lambda: agent.ask("status")["idle"])


def test_events_are_logged_on_command_until_they_are_stopped(directory: Path) -> None:
    agent = AgentUnderTest(directory, mission(events={"source": "none"}))
    try:
        agent.start()
        event = {"event_id": 1, "data": base64.b64encode(bytes(256)).decode()}
        for _ in range(3):  # they fill a block
            agent.ask("log", **event)
        assert agent.ask("status")["completed"] == 1
        agent.ask("stop_events")
        for _ in range(3):
            agent.ask("log", **event)
        assert agent.ask("status")["completed"] == 1
        with pytest.raises(AgentRefusedError, match="in base64"):
            agent.ask("log", event_id=1, data="?")
        with pytest.raises(AgentRefusedError, match="1 to 254"):
            agent.ask("log", event_id="1", data="AQ==")
    finally:
        agent.process.kill()
        agent.process.communicate()


def test_command_changes_the_quirks_of_the_mission(directory: Path) -> None:
    agent = AgentUnderTest(directory, mission(quirks={"ignore_commit": 1}))
    try:
        agent.start()
        inception, block = InceptionBlock(b"test"), Block(9, 1, b"x")
        commit = CommitBlock(block, next_chain_hash(inception.chain_hash, block.block_hash))
        for sequence, probability in enumerate((None, 0, 1)):
            if probability is not None:
                agent.ask("quirk", name="ignore_commit", value=probability)
            agent.send(encode(9, sequence, commit))
            agent.wait_for(lambda handled=sequence + 1: agent.ask("status")["handled"] == handled)
        trace = read_trace(directory / "7.trace.jsonl")
        assert trace is not None
        assert [run.branch for run in trace.runs] == ["ignored by quirk", "committed", "ignored by quirk"]
    finally:
        agent.process.kill()
        agent.process.communicate()


def test_quirk_makes_the_agent_wrong_until_it_is_removed(agent: AgentUnderTest) -> None:
    agent.start()
    assert agent.ask("quirk", name="never_reconcile", value=True)["never_reconcile"] is True
    agent.ask("reconcile")
    agent.wait_for(lambda: agent.ask("status")["handled"] == 1)
    assert agent.ask("status")["reconciles"] == 0
    agent.ask("quirk", name="never_reconcile", value=False)
    agent.ask("reconcile")
    agent.wait_for(lambda: agent.ask("status")["reconciles"] == 1)


@pytest.mark.parametrize(
    ("command", "arguments", "sentence"),
    [
        ("fly", {}, "unknown command 'fly': there are status, start"),
        ("start", {"epoch_us": "now"}, "epoch_us"),
        ("start", {"epoch_us": True}, "epoch_us"),
        ("reconcile", {}, "has not started"),
        ("log", {"event_id": 1, "data": "AQ=="}, "has not started"),
        ("quirk", {"name": "ignore_commit", "value": 7}, "probability"),
        ("quirk", {"name": "never_reconcile", "value": 1}, "never_reconcile must be true or false"),
        ("quirk", {"name": "never_reconciles" * 1000, "value": True}, "the nearest are never_reconcile"),
    ],
)
def test_impossible_command_is_answered_with_one_sentence(
    agent: AgentUnderTest, command: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(AgentRefusedError, match=sentence):
        agent.ask(command, **arguments)
    assert agent.ask("status")["ok"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"event_id": 0, "data": "AQ=="}, "1 to 254"),
        ({"event_id": 255, "data": "AQ=="}, "1 to 254"),
        ({"event_id": 1, "data": "é"}, "base64"),
        ({"event_id": 1, "data": base64.b64encode(bytes(257)).decode()}, "at most 256 bytes of data, not 257"),
    ],
)
def test_invalid_event_is_refused_with_one_sentence(
    agent: AgentUnderTest, arguments: dict[str, Any], sentence: str
) -> None:
    agent.start()
    with pytest.raises(AgentRefusedError, match=sentence):
        agent.ask("log", **arguments)
    assert agent.ask("status")["handled"] == 0


def test_garbage_on_the_control_socket_ends_only_its_connection(agent: AgentUnderTest) -> None:
    with socket.socket(socket.AF_UNIX) as sock:
        descriptor = os.open(agent.directory, os.O_PATH)
        sock.connect(f"/proc/self/fd/{descriptor}/7.control")
        os.close(descriptor)
        with sock.makefile("rb") as answers:
            for line, unsupported in ((b"\xff\xfe not json", False), (b"[1]", False), (b'{"command": "fly"}', True)):
                sock.sendall(line + b"\n")
                answer = json.loads(answers.readline())
                assert (answer["ok"], answer.get("unsupported", False)) == (False, unsupported)
        with pytest.raises(ConnectionError):
            for _ in range(1000):
                sock.sendall(b"x" * 65536)
    assert agent.ask("status")["ok"]


def test_port_in_use_ends_with_one_sentence_and_status_2(agent: AgentUnderTest, tmp_path: Path) -> None:
    other = AgentUnderTest(tmp_path, agent.document)
    assert other.process.wait(DEADLINE_S) == 2
    assert other.process.stderr is not None
    said = other.process.stderr.read()
    assert said.count("\n") == 1
    assert f"UDP port {agent.document['network']['port']}: Address already in use" in said
    assert agent.ask("status")["ok"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"schema": "ucp-mission/9"}, "`schema` is 'ucp-mission/9'"),
        ({"agent_id": 8}, "not on the `roster`"),
        ({"roster": [True, 7]}, "`roster`"),
        ({"epoch_us": True}, "`epoch_us`"),
        ({"agent_id": "7"}, "`agent_id` must be a whole number"),
        ({"roster": [7, True]}, "`roster` must list agent IDs"),
        ({"speedup": 0}, "`speedup` must be a number above 0"),
        ({"speedup": 10**400}, "`speedup` must be a number above 0"),
        ({"network": {"address": "here"}}, "`network.address` must be an IPv4 address"),
        ({"network": {"address": 7}}, "`network.address` must be an IPv4 address"),
        ({"settings": {"vote": 1}}, "`settings.vote` is unknown"),
        ({"settings": {"vote_timeout_s": "x"}}, "`settings`"),
        ({"events": {"source": "dice"}}, "random, mavlink or none"),
        ({"quirks": {"ignore_commit": 2}}, "`quirks`"),
        ({"quirks": ["hide_commits"]}, "`quirks` must be a JSON object"),
        ({"initial_data": "!"}, "not base64"),
        ({"initial_data": "é"}, "not base64"),
        ({"store": 7}, "`store` must be the path of a file"),
        ({"features": "store"}, "`features` must list names"),
    ],
)
def test_wrong_mission_file_ends_with_one_sentence_and_status_2(
    tmp_path: Path, change: dict[str, Any], sentence: str
) -> None:
    agent = AgentUnderTest(tmp_path, mission(**change))
    assert agent.process.wait(DEADLINE_S) == 2
    assert agent.process.stderr is not None
    said = agent.process.stderr.read()
    assert sentence in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("needs", "sentence"),
    [
        ({"contract": 3, "features": ["store", "signatures"], "keys": {}}, "needs the feature 'signatures'"),
        ({"quirks": {"hide_commit": True}}, "`quirks`: unknown quirk 'hide_commit': of the"),
    ],
)
def test_mission_with_a_missing_feature_ends_with_status_127(
    tmp_path: Path, needs: dict[str, Any], sentence: str
) -> None:
    agent = AgentUnderTest(tmp_path, mission(**needs))
    assert agent.process.wait(DEADLINE_S) == 127
    assert agent.process.stderr is not None
    said = agent.process.stderr.read()
    assert f"7.mission.json: {sentence}" in said
    assert said.count("\n") == 1


def test_agent_plays_a_later_contract_without_new_features() -> None:
    later = mission(contract=3, features=["store"], keys={"never": "heard of"}, quirks={"hide_commit": False})
    assert parse_mission(later).agent_id == 7


def test_killed_agent_leaves_no_incomplete_export(directory: Path) -> None:
    """If the agent is killed at any time, the old export or the complete new export remains."""
    rng = Random(5)
    for _ in range(5):
        agent = AgentUnderTest(directory, mission(events={"source": "random", "mean_s": 1.0}))
        agent.start()
        agent.ask("export")
        with socket.socket(socket.AF_UNIX) as sock:
            descriptor = os.open(directory, os.O_PATH)
            sock.connect(f"/proc/self/fd/{descriptor}/7.control")
            os.close(descriptor)
            sock.sendall(b'{"command": "export"}\n' * 200)
            time.sleep(rng.random() * 0.05)  # only the time of the kill is random
            agent.process.kill()
        agent.process.communicate()
        assert read_export(directory / "7.chain.json").agent_id == 7
        (directory / "7.control").unlink()


@pytest.mark.lab
def test_full_disk_keeps_the_old_export_and_the_agent_continues(tmp_path: Path) -> None:
    script = r"""
import json, pathlib, subprocess, sys, time
sys.path.insert(0, sys.argv[2])
from tests.ucp.test_node import AgentUnderTest, mission
from harness.play.agent_control import AgentRefusedError
disk = pathlib.Path(sys.argv[1])
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk], check=True)
agent = AgentUnderTest(disk, mission(events={"source": "random", "mean_s": 1.0}))
agent.start()
agent.ask("export")
before = (disk / "7.chain.json").read_text()
(disk / "ballast").write_bytes(b"")
try:
    with (disk / "ballast").open("wb", buffering=0) as ballast:
        while ballast.write(bytes(4096)) == 4096: pass
except OSError: pass
try:
    agent.ask("export")
    sys.exit("it claims to have exported to a full disk")
except AgentRefusedError as error:
    print(error)
assert (disk / "7.chain.json").read_text() == before
agent.wait_for(lambda: agent.ask("status")["trace_problem"])
print(agent.ask("status")["trace_problem"])
trace = (disk / "7.trace.jsonl").read_text()
assert trace.endswith("\n"), "half a line"
(disk / "ballast").unlink()
agent.ask("export")
assert len(json.loads((disk / "7.chain.json").read_text())["chain"]) >= 0
assert not list(disk.glob(".*")), "a temporary file is left"
agent.process.terminate()
sys.exit(agent.process.wait(10))
"""
    disk = tmp_path / "disk"
    disk.mkdir()
    private = ["unshare", "--user", "--map-root-user", "--mount"]
    done = subprocess.run(
        [*private, sys.executable, "-c", script, str(disk), str(Path(__file__).parents[2])],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("No space left on device") == 2


def test_killed_agent_continues_from_its_store(directory: Path, tmp_path: Path) -> None:
    """The agent is killed at any time. When it starts again, it has its completed blocks and rejoins the active
    mission.
    """
    epoch_us = round(time.time() * 1e6)
    document = mission(events={"source": "random", "mean_s": 1.0}, epoch_us=epoch_us, store="../7.store")
    known: list[str] = []
    for incarnation in range(1, 4):
        place = directory / str(incarnation)
        place.mkdir()
        agent = AgentUnderTest(place, {**document, "seed": incarnation, "network": mission()["network"]})
        enough = len(known) + 2
        agent.wait_for(lambda agent=agent, enough=enough: agent.ask("status")["completed"] >= enough)
        agent.process.kill()
        agent.process.communicate()
        trace = read_trace(place / "7.trace.jsonl")
        assert trace is not None
        if known:
            first = trace.runs[0]
            assert (first.handler, first.trigger.kind) == ("reconcile_finalize", "boot")
            completed = [block for operation, block in first.changes if operation == "complete"]
            assert completed[: len(known)] == known
            assert len(completed) <= len(known) + 1  # the kill can come after the store and before the trace
            assert first.t > 1.0
        known = trace.completed()
        assert len(set(known)) == len(known) >= 2 * incarnation
    assert [path.name for path in directory.iterdir() if path.is_file()] == ["7.store"]


def test_agent_writes_trace_and_store_before_it_sends(tmp_path: Path) -> None:
    """If the agent is killed after it sends a message, other agents may have received this message."""
    sent = []

    class Radio:
        def sendto(self, datagram: bytes, address: Any) -> None:
            _, sequence, message = decode(datagram)
            assert isinstance(message, BlockAddRequest)
            trace = read_trace(tmp_path / "7.trace.jsonl")
            assert trace is not None
            assert sequence in {said.seq for run in trace.runs for said in run.sent}
            found = Store(tmp_path / "7.store", node.agent.state).recovered
            assert found is not None
            assert [block.block_hash for block in found.deque] == [message.block_hash]
            sent.append(message)

    node = Node(parse_mission(mission(store="7.store")), tmp_path)
    node._socket.close()
    node._socket = Radio()  # type: ignore[assignment]
    node._begin(round(time.time() * 1e6))
    for _ in range(3):
        node.log_event(1, bytes(256))
    assert len(sent) == 1


@pytest.mark.parametrize("left", ["", "{}\n", '{}\n{"t":1,"ha', '{"t":1,"ha' * 20000, "{}\n" + "x" * 100_000])
def test_agent_removes_an_incomplete_last_line_of_its_trace(tmp_path: Path, left: str) -> None:
    path = tmp_path / "7.trace.jsonl"
    path.write_text(left)
    trace = TraceFile(path)
    trace.write('{"schema"}\n')
    trace.close()
    assert path.read_text() == ("{}\n" if left.startswith("{}") else "") + '{"schema"}\n'


def test_full_disk_ends_the_trace_and_the_agent_continues(directory: Path) -> None:
    (directory / "7.trace.jsonl").symlink_to("/dev/full")
    agent = AgentUnderTest(directory, mission(epoch_us=round(time.time() * 1e6)))
    agent.wait_for(lambda: agent.ask("status")["trace_problem"] == "No space left on device")
    agent.process.terminate()
    assert agent.process.wait(DEADLINE_S) == 0


def test_flood_of_datagrams_fills_no_disk_and_is_counted(directory: Path) -> None:
    flooded = mission(epoch_us=round(time.time() * 1e6))
    agent = AgentUnderTest(directory, flooded)
    agent.wait_for(lambda: agent.ask("status")["started"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
        attacker.bind(("127.0.0.2", 0))
        attacker.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        for _ in range(20):
            for _ in range(100):
                attacker.sendto(b"x" * 1472, (flooded["network"]["broadcast"], flooded["network"]["port"]))
            agent.ask("status")  # so that the agent has read some of them
    agent.process.terminate()
    assert agent.process.wait(DEADLINE_S) == 0
    trace = read_trace(directory / "7.trace.jsonl")
    assert trace is not None
    assert trace.dropped()["wrong magic"] > 1000
    assert any(isinstance(aside, DroppedDatagram) and aside.count > 100 for _, aside in trace.asides)
    assert (directory / "7.trace.jsonl").stat().st_size < 1.2 * 1024 * 1024


@pytest.mark.lab
def test_trace_leaves_the_disk_to_the_store_and_the_export(tmp_path: Path) -> None:
    script = r"""
import os, pathlib, subprocess, sys
sys.path.insert(0, sys.argv[2])
from tests.ucp.test_node import AgentUnderTest, mission
disk = pathlib.Path(sys.argv[1])
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk], check=True)
agent = AgentUnderTest(disk, mission(events={"source": "random", "mean_s": 1.0}, store="7.store"))
agent.start()
agent.ask("export")
agent.wait_for((disk / "7.store").exists)
with (disk / "ballast").open("wb", buffering=0) as ballast:
    while os.statvfs(disk).f_bavail * 4096 > 200_000: ballast.write(bytes(4096))
agent.wait_for(lambda: agent.ask("status")["trace_problem"])
written = (disk / "7.store").stat().st_size
agent.wait_for(lambda: (disk / "7.store").stat().st_size > written)
try:
    with (disk / "rest").open("wb", buffering=0) as ballast:
        while ballast.write(bytes(4096)) == 4096: pass
except OSError: pass
before = (disk / "7.chain.json").stat().st_mtime_ns
agent.ask("export")
assert (disk / "7.chain.json").stat().st_mtime_ns > before
agent.process.terminate()
sys.exit(agent.process.wait(10))
"""
    disk = tmp_path / "disk"
    disk.mkdir()
    private = ["unshare", "--user", "--map-root-user", "--mount"]
    done = subprocess.run(
        [*private, sys.executable, "-c", script, str(disk), str(Path(__file__).parents[2])],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr


def test_error_names_the_file_or_the_port_that_is_unavailable(directory: Path) -> None:
    (directory / "7.trace.jsonl").mkdir()
    agent = AgentUnderTest(directory, mission())
    assert (
        agent.process.communicate(timeout=DEADLINE_S)[1] == f"agent 7: {directory / '7.trace.jsonl'}: Is a directory\n"
    )
    (directory / "7.trace.jsonl").rmdir()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        port = taken.getsockname()[1]
        network = {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": port}
        agent = AgentUnderTest(directory, mission(network=network))
        said = agent.process.communicate(timeout=DEADLINE_S)[1]
    assert agent.process.returncode == 2
    assert said == (
        f"agent 7: UDP port {port}: Address already in use; another agent may be running here, or choose another port\n"
    )


def test_agent_that_joins_late_logs_no_earlier_events(directory: Path) -> None:
    """If the agent logged them, it would log all events since the start of the mission at once."""
    epoch_us = round((time.time() - 100) * 1e6)
    agent = AgentUnderTest(directory, mission(events={"source": "random", "mean_s": 20.0}, epoch_us=epoch_us))
    agent.wait_for(lambda: agent.ask("status")["handled"] > 3)
    agent.process.kill()
    agent.process.communicate()
    trace = read_trace(directory / "7.trace.jsonl")
    assert trace is not None
    events = [run.t for run in trace.runs if run.trigger.kind == "event"]
    assert min(events) > 10_000
    assert all(later > earlier for earlier, later in pairwise(events))


def test_file_that_is_no_store_ends_with_one_sentence_and_status_2(tmp_path: Path) -> None:
    (tmp_path / "7.store").write_text("precious\n")
    agent = AgentUnderTest(tmp_path, mission(store="7.store"))
    assert agent.process.wait(DEADLINE_S) == 2
    assert agent.process.stderr is not None
    said = agent.process.stderr.read()
    assert "7.store is not a store: move the file away" in said
    assert said.count("\n") == 1


def test_helper_notices_an_agent_that_does_not_answer(agent: AgentUnderTest) -> None:
    async def ask() -> None:
        await AgentControl(agent.directory / "7.control").ask("status", timeout_s=0.2)

    agent.process.send_signal(signal.SIGSTOP)
    with pytest.raises(AgentSilentError, match=r"no answer to status within 0\.2 s"):
        asyncio.run(ask())
    agent.process.send_signal(signal.SIGCONT)
