"""Test the Docker backend if Docker is missing or does not answer."""

import asyncio
import json
import os
import re
import socket
import struct
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import docker.errors
import pytest
import requests
import yaml

from harness.play.containers import _container_preflight, _images, docker_engine, ownership
from harness.play.containers._container import STDERR, STDOUT, ContainerOutput
from harness.play.containers._images import ContainerImage
from harness.play.keyring.key_directory import KeyDirectory
from harness.scenario import Scenario
from tests.harness.command import harness, sentences, write_scenario
from tests.harness.secure.secrets import leaks, left_in
from tests.harness.secure.secrets import secrets as secrets_of


def listening(path: Path) -> socket.socket:
    """Return a server socket that accepts connections but never answers."""
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.listen()
    return server


def test_missing_engine_causes_one_sentence(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path)
    for host, word in (
        (f"unix://{tmp_path}/nowhere.sock", "there is no Docker engine: .* install it"),
        (
            "tcp://192.0.2.1:2375",
            "DOCKER_HOST is tcp://192.0.2.1:2375: the harness connects only containers on this machine",
        ),
    ):
        asked = ("run", scenario, "--backend", "docker", "--out", tmp_path / "run")
        done = harness(*asked, env={**os.environ, "DOCKER_HOST": host})
        assert done.returncode == 3
        (sentence,) = sentences(done.stderr)
        assert re.match(word, sentence)
        assert not (tmp_path / "run").exists()


def test_stopped_engine_causes_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "docker.sock"
    listening(path).close()
    monkeypatch.setenv("DOCKER_HOST", f"unix://{path}")
    with pytest.raises(docker_engine.DockerError, match="is not running: no process listens"):
        docker_engine.DockerEngine.connect()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody who may not")
def test_inaccessible_engine_causes_one_sentence(tmp_path: Path) -> None:
    path = Path("/tmp", f"ucp-test-{os.getpid()}.sock")  # noqa: S108  (every user can reach it)
    server = listening(path)
    path.chmod(0o600)
    code = f"""
import os; from harness.play.containers import docker_engine
os.environ["DOCKER_HOST"] = "unix://{path}"; os.setuid(65534)
try: docker_engine.DockerEngine.connect()
except docker_engine.DockerError as error: print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    server.close()
    path.unlink()
    assert done.stdout == f"{path} is not accessible to this user: use sudo\n", done.stderr


def test_silent_engine_causes_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "docker.sock"
    server = listening(path)
    monkeypatch.setenv("DOCKER_HOST", f"unix://{path}")
    monkeypatch.setattr(docker_engine, "GREETING_LIMIT_S", 1.0)
    with pytest.raises(docker_engine.DockerError, match="does not answer: restart it"):
        docker_engine.DockerEngine.connect()
    server.close()


def test_silent_engine_gets_no_further_calls() -> None:
    asked = []

    def late() -> None:
        asked.append(1)
        raise TimeoutError

    one = docker_engine.DockerEngine(SimpleNamespace(close=lambda: None))  # type: ignore[arg-type]
    for _ in range(2):
        with pytest.raises(docker_engine.DockerError, match=r"stopped answering \(look\).*`ucp-harness clean`"):
            one.do("look", late)
    assert len(asked) == 1
    one.close()


def test_full_disk_does_not_count_as_a_stopped_engine() -> None:
    def refuse() -> None:
        answer = requests.Response()
        answer.status_code = 500
        raise docker.errors.APIError("500", answer, "write /var/lib/docker/x: no space left on device")

    one = docker_engine.DockerEngine(SimpleNamespace(close=lambda: None))  # type: ignore[arg-type]
    with pytest.raises(docker_engine.DockerError, match=r"disk is full \(create x\)"):
        one.do("create x", refuse)
    assert one.do("look", lambda: "it answers") == "it answers"
    one.close()


def test_image_that_cannot_be_built_causes_one_sentence() -> None:
    steps = [{"stream": "Step 1/9 : ARG BASE"}, {"stream": " ---> 1"}, {"error": "no such host"}]
    missing = requests.Response()
    missing.status_code = 404

    def inspect(_: str) -> None:
        raise docker.errors.APIError("404", missing, "no such image")

    said: list[str] = []
    api = SimpleNamespace(close=lambda: None, inspect_image=inspect, build=lambda **_: iter(steps))
    one = docker_engine.DockerEngine(api)  # type: ignore[arg-type]
    with pytest.raises(docker_engine.DockerError, match=r"cannot be built \(no such host\): .*--image-from-host"):
        _images.project(one, said.append)
    assert said[1:] == ["building the image: Step 1/9 : ARG BASE"] * 2
    one.close()


def test_docker_backend_requires_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(docker_engine.DockerError, match="use sudo"):
        _container_preflight.require_root()


def test_debugger_must_be_in_the_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = {"name": "gdb", "vehicles": {"each": {2: {"debugger": "gdb"}}}}
    with pytest.raises(docker_engine.DockerError, match=r"the project's image has no gdb: use .*--image-from-host"):
        _container_preflight.check_debuggers(Scenario.model_validate(document))
    from_host = Scenario.model_validate({**document, "docker": {"image_from_host": True}})
    for place, shared in ((tmp_path, False), (Path(sys.prefix, "bin"), True)):
        monkeypatch.setattr("shutil.which", lambda name, place=place: str(place / name))
        with (
            nullcontext()
            if shared
            else pytest.raises(docker_engine.DockerError, match="in a directory that containers do not share")
        ):
            _container_preflight.check_debuggers(from_host)


def test_user_mode_linux_has_no_engine(tmp_path: Path) -> None:
    asked = ("run", write_scenario(tmp_path), "--kernel", "uml", "--backend", "docker", "--out", tmp_path / "run")
    done = harness(*asked)
    assert (done.returncode, len(sentences(done.stderr))) == (2, 1)


def test_run_belongs_to_its_orchestrator_while_that_exists() -> None:
    assert ownership.is_alive(ownership.this_process())
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    boot, _, _ = ownership.this_process().split()
    started = Path(f"/proc/{child.pid}/stat").read_text().rsplit(")", 1)[1].split()[19]
    assert ownership.is_alive(f"{boot} {child.pid} {started}")
    assert not ownership.is_alive(f"{boot} {child.pid} {int(started) + 1}"), "another process of the same number"
    assert not ownership.is_alive(f"another-boot {child.pid} {started}")
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert not ownership.is_alive(f"{boot} {child.pid} {started}"), "dead, if not buried"
    child.wait()
    for nonsense in ("", "x", f"{boot} -1 5", f"{boot} {child.pid} None"):
        assert not ownership.is_alive(nonsense)


@pytest.mark.parametrize("name", ["loss 15 %", "..", "é", "-x-", "a" * 300])
def test_run_names_are_valid_container_names(name: str, tmp_path: Path) -> None:
    found = ownership.run_name(tmp_path / name)
    assert re.fullmatch(r"[a-zA-Z0-9][a-zA-Z0-9_.-]{1,60}", found)
    assert found != ownership.run_name(tmp_path / "other" / name)


def test_output_of_a_container_goes_to_the_right_file(tmp_path: Path) -> None:
    def frame(output: int, said: bytes) -> bytes:
        return struct.pack(">B3xI", output, len(said)) + said

    said = frame(STDOUT, b"one\n") + frame(STDERR, b"two\n") + frame(STDOUT, b"") + frame(STDOUT, b"three\n")

    async def read() -> None:
        near, far = socket.socketpair()
        output = ContainerOutput(SimpleNamespace(_sock=near, close=near.close), tmp_path / "out", tmp_path / "err")
        for byte in said:
            far.send(bytes([byte]))
            await asyncio.sleep(0)
        far.close()
        await asyncio.wait_for(output.ended.wait(), 10)

    asyncio.run(read())
    assert (tmp_path / "out").read_bytes() == b"one\nthree\n"
    assert (tmp_path / "err").read_bytes() == b"two\n"


def test_image_is_built_from_the_packages_and_named_by_their_content(monkeypatch: pytest.MonkeyPatch) -> None:
    context = _images.context()
    assert {"Dockerfile", "ucp/node.py", "sitl/embedded.py"} < set(context)
    assert not any("__pycache__" in name or name.startswith("harness") for name in context)
    name = _images.project_name()
    assert name == _images.project_name()
    monkeypatch.setattr(_images, "context", lambda: {**context, "ucp/node.py": b"pass"})
    assert _images.project_name() != name


def test_image_has_its_own_interpreter_environment_and_files(tmp_path: Path) -> None:
    program = tmp_path / "arducopter"
    program.touch()
    argv = [sys.executable, "-m", "ucp.node", str(program), "/no/such"]
    env = {**os.environ, "HOW": "so"}
    ours, foreign, host = (
        ContainerImage("a", "python3"),
        ContainerImage("b", "python3", foreign=True),
        _images.host_image(),
    )
    assert ours.command(argv)[0] == "python3"
    assert ours.environment(env) == {"HOW": "so"}
    assert (ours.shared(argv), foreign.shared(argv)) == ([program], [])
    assert host.command(argv) == argv
    assert host.environment(env) == env
    assert {program} < set(host.shared(argv))
    assert any(Path(sys.executable).is_relative_to(path) for path in host.mounted)
    interpreter = tmp_path / "environment" / "bin" / "python"
    interpreter.parent.mkdir(parents=True)
    interpreter.touch()
    assert interpreter in ours.shared([str(interpreter)])
    (tmp_path / "environment" / "pyvenv.cfg").touch()
    assert ours.shared([str(interpreter)]) == [tmp_path / "environment"]


def emitted(tmp_path: Path, *options: object, **keys: Any) -> dict[str, Any]:
    file = tmp_path / "compose.yaml"
    done = harness("run", write_scenario(tmp_path, **keys), "--emit-compose", file, *options)
    assert done.returncode == 0, done.stderr
    assert "no loss" in file.read_text()
    document: dict[str, Any] = yaml.safe_load(file.read_text())
    return document


def test_compose_file_has_all_vehicles_at_their_addresses(tmp_path: Path) -> None:
    services = emitted(tmp_path, agents=[1, 300], vehicles={"kind": "embedded"}, docker={"memory_mib": 64})["services"]
    assert list(services) == ["vehicle-1", "agent-1", "vehicle-300", "agent-300", "start"]
    assert services["vehicle-300"]["networks"]["air"]["ipv4_address"] == "10.77.1.44"
    assert services["agent-300"]["network_mode"] == "service:vehicle-300"
    assert services["agent-1"]["mem_limit"] == "64m"
    assert services["agent-1"]["cap_drop"] == ["ALL"]
    mission = json.loads((tmp_path / "compose/agents/300.mission.json").read_text())
    assert mission["network"] == {"address": "10.77.1.44", "broadcast": "10.79.255.255", "port": 14600}
    assert mission["epoch_us"] is None
    assert (tmp_path / "compose/image/ucp/node.py").exists()
    again = harness("run", tmp_path / "scenario.yaml", "--emit-compose", tmp_path / "compose.yaml")
    assert again.returncode == 2
    assert "compose.yaml exists: choose another name" in sentences(again.stderr)[0]


def test_compose_file_has_no_secret_and_mounts_the_own_bundle_only(tmp_path: Path) -> None:
    home = KeyDirectory.new(tmp_path / "home", [1, 2], seals=True, epoch_s=600.0)
    home.write_bundles(tmp_path / "bundles")
    keys = {"agents": 2, "vehicles": {"kind": "none"}}
    document = emitted(tmp_path, **keys, security={"keys": str(tmp_path / "bundles"), "seal": True})
    assert document["secrets"]["2.bundle.json"] == {"file": str(tmp_path / "bundles/2.bundle.json")}
    assert [document["services"][f"agent-{agent}"]["secrets"] for agent in (1, 2)] == [
        ["1.bundle.json"],
        ["2.bundle.json"],
    ]
    assert "secrets" not in document["services"]["start"]
    mission = json.loads((tmp_path / "compose/agents/2.mission.json").read_text())
    assert mission["security"] == {"bundle": "/run/secrets/2.bundle.json"}
    assert mission["features"] == ["secured", "sealed"]
    left = [("compose.yaml", (tmp_path / "compose.yaml").read_bytes()), *left_in(tmp_path / "compose")]
    assert leaks(secrets_of(home, 2), left) == []
    for directory in ("fresh", str(home.directory)):
        asked = write_scenario(tmp_path, **keys, security={"keys": directory})
        refused = harness("run", asked, "--emit-compose", tmp_path / "other.yaml")
        assert refused.returncode == 2
        assert "ucp-harness keys bundle" in refused.stderr
        assert not (tmp_path / "other.yaml").exists()


def test_compose_file_runs_own_command_in_own_image(tmp_path: Path) -> None:
    own = {"docker": {"image": "mine:3"}, "agent_command": ["/app/agent", "--fast"], "vehicles": {"kind": "none"}}
    services = emitted(tmp_path, agents=[7], **own)["services"]
    agent = services["agent-7"]
    assert (agent["image"], agent["entrypoint"], agent["command"]) == (
        "mine:3",
        ["/app/agent"],
        ["--fast", "7.mission.json"],
    )
    assert agent["volumes"] == ["./compose:/ucp"]
    assert "build" not in agent
    assert services["start"]["depends_on"] == ["agent-7"]


def test_compose_file_runs_only_named_agents_in_own_image(tmp_path: Path) -> None:
    own = {"docker": {"image": "mine:3"}, "agent_command": {"7": ["/app/agent"]}, "vehicles": {"kind": "none"}}
    services = emitted(tmp_path, agents=[7, 8], **own)["services"]
    assert (services["agent-7"]["image"], services["agent-7"]["entrypoint"]) == ("mine:3", ["/app/agent"])
    assert services["agent-8"]["image"] == services["start"]["image"] != "mine:3"
    assert services["agent-8"]["command"] == ["-P", "-m", "ucp.node", "8.mission.json"]
    assert "build" in services["agent-8"]


def test_compose_file_starts_all_agents_at_once(tmp_path: Path) -> None:
    from harness.play.containers import start

    heard: list[Any] = []

    async def serve() -> int:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            heard.append(json.loads(await reader.readline()))
            writer.write(b'{"ok": true}\n')

        for agent in (1, 2):
            (tmp_path / f"{agent}.mission.json").touch()
            await asyncio.start_unix_server(answer, tmp_path / f"{agent}.control")
        command = [sys.executable, start.__file__, str(tmp_path)]
        return await (await asyncio.create_subprocess_exec(*command)).wait()

    assert asyncio.run(serve()) == 0
    assert [one["command"] for one in heard] == ["start", "start"]
    assert heard[0]["epoch_us"] == heard[1]["epoch_us"]
