"""Build or choose the Docker images of vehicles and agents. Three kinds of images exist:

project     built from the Dockerfile beside this file, with the installed packages `ucp` and `sitl`
named       an image that the scenario names
from_host   an empty image with this machine's programs and packages mounted read-only; it needs no registry
"""

import hashlib
import importlib.util
import io
import json
import os
import shutil
import sys
import tarfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import docker.errors

from harness.play.containers import ownership
from harness.play.containers.docker_engine import DockerEngine, DockerError
from harness.scenario import Scenario

HOST_IMAGE = "ucp-harness-host:empty"
PROJECT_IMAGE = "ucp-harness-agent"
PACKAGES = ("sitl", "ucp")
SYSTEM = ("/bin", "/lib", "/lib32", "/lib64", "/libx32", "/usr")
INSTEAD = "use this machine's files (--image-from-host, `docker.image_from_host`), or name an image (`docker.image`)"


@dataclass(frozen=True)
class ContainerImage:
    """A Docker image."""

    name: str
    python: str
    """The Python interpreter in the image."""
    mounted: tuple[Path, ...] = ()
    """The directories of this machine that containers of this image can read."""
    foreign: bool = False

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command that starts the program of `argv` inside the container."""
        return [self.python if word == sys.executable else word for word in argv]

    def environment(self, env: Mapping[str, str]) -> dict[str, str]:
        """Return the environment variables for a program inside the container. If the container shares no directories
        with this machine, the result has only the variables that differ from the variables of this process.
        """
        return {key: value for key, value in env.items() if self.mounted or os.environ.get(key) != value}

    def shared(self, argv: Sequence[str]) -> list[Path]:
        """Return the paths on this machine that the container must share, so that the command `argv` can start in the
        container.
        """
        files = [Path(word) for word in self.command(argv) if Path(word).is_absolute() and Path(word).is_file()]
        return outermost([*self.mounted, *([] if self.foreign else map(_with_environment, files))])


def from_host(engine: DockerEngine) -> ContainerImage:
    """Return an image whose containers use the programs of this machine. Create the image if it does not exist. Raises
    DockerError.
    """
    if not _exists(engine, HOST_IMAGE):
        repository, tag = HOST_IMAGE.split(":")
        engine.do(
            "import an empty image",
            engine.api.import_image_from_data,
            _tar({}),
            repository=repository,
            tag=tag,
            changes=[f"LABEL {ownership.PROJECT}=host"],
        )
    return host_image()


def host_image() -> ContainerImage:
    return ContainerImage(HOST_IMAGE, sys.executable, tuple(outermost(_host_directories())))


def is_shared(program: Path) -> bool:
    """Return true if this program also exists in containers that use the programs of this machine, because they share
    its directory.
    """
    mounted = host_image().mounted
    return all(any(path.is_relative_to(outer) for outer in mounted) for path in (program, program.resolve()))


def named(engine: DockerEngine, name: str) -> ContainerImage:
    """Return the image with this name. Raises DockerError if this machine does not have the image."""
    if not _exists(engine, name):
        raise DockerError(f"this machine has no image {name}: docker pull {name}, or build it")
    return ContainerImage(name, "python3", foreign=True)


def agents_in_named(scenario: Scenario) -> Iterable[int]:
    """Return the agents that run in the image that the scenario names. If the key `agent_command` lists commands by
    agent, only the agents with a command run in this image. Otherwise all agents run in it.
    """
    if scenario.docker.image is None:
        return ()
    return scenario.foreign if isinstance(scenario.agent_command, dict) else scenario.roster


def project(engine: DockerEngine, say: Callable[[str], object]) -> ContainerImage:
    """Return the image of this project. If the image does not exist, build it and report each step. Raises
    DockerError.
    """
    name = project_name()
    if not _exists(engine, name):
        say("building the image")
        _build(engine, name, say)
    return ContainerImage(name, "python3")


def project_name() -> str:
    """Return the name of this project's Docker image. The name depends on the content of the image."""
    made_of = _tar(context()) + json.dumps(build_arguments()).encode("ascii")
    return f"{PROJECT_IMAGE}:{version('ucp-harness')}-{hashlib.sha256(made_of).hexdigest()[:12]}"


def build_arguments() -> dict[str, str]:
    """Return the versions of the packages to install in the Docker image, which are the versions on this machine."""
    arguments = {"PYMAVLINK": version("pymavlink")}
    with suppress(PackageNotFoundError):  # optional: needed only for secure missions
        arguments["CRYPTOGRAPHY"] = version("cryptography")
    return arguments


def _build(engine: DockerEngine, name: str, say: Callable[[str], object]) -> None:
    steps = engine.do(
        "build the image",
        engine.api.build,
        fileobj=io.BytesIO(_tar(context())),
        custom_context=True,
        tag=name,
        rm=True,
        forcerm=True,
        decode=True,
        network_mode="host",
        labels={ownership.PROJECT: "agent"},
        buildargs=build_arguments(),
    )
    now = ""
    for step in steps:
        if "error" in step:
            raise DockerError(f"the project's image cannot be built ({step['error'].strip()}): {INSTEAD}")
        word = step.get("stream", "").strip()
        now = word if word.startswith("Step ") else now
        say(f"building the image: {now}")


def context() -> dict[str, bytes]:
    """Return the files from which the image of this project is built: the Dockerfile and the Python packages."""
    files = {"Dockerfile": Path(__file__).with_name("Dockerfile").read_bytes()}
    for package in PACKAGES:
        root = _package(package)
        for path in sorted(root.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                files[f"{package}/{path.relative_to(root)}"] = path.read_bytes()
    return files


def _tar(files: Mapping[str, bytes]) -> bytes:
    """Return a tar archive of the files. Equal files always give the same archive."""
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o644
            tar.addfile(entry, io.BytesIO(content))
    return archive.getvalue()


def _with_environment(program: Path) -> Path:
    """Return the path that a container must share to run the program. This is the virtual environment of the program.
    If the program belongs to no virtual environment, it is the program itself.
    """
    environment = program.parent.parent
    return environment if (environment / "pyvenv.cfg").is_file() else program


def _exists(engine: DockerEngine, name: str) -> bool:
    try:
        engine.do(f"look for the image {name}", engine.api.inspect_image, name)
    except docker.errors.APIError as error:
        if error.status_code in (400, 404):  # 400: the name is invalid
            return False
        raise DockerError(f"the image {name} cannot be used: {error.explanation}") from None
    return True


def _host_directories() -> Iterable[Path]:
    yield from filter(Path.exists, map(Path, SYSTEM))
    yield from (Path(sys.prefix), Path(sys.base_prefix))
    yield from map(_package, PACKAGES)
    yield _package("pymavlink").parent


def _package(name: str) -> Path:
    spec = importlib.util.find_spec(name)
    assert spec is not None and spec.submodule_search_locations, "we depend on it"
    return Path(next(iter(spec.submodule_search_locations))).absolute()


def outermost(paths: Iterable[Path]) -> list[Path]:
    """Return the directories of the list that do not lie inside another directory of the list."""
    roots: list[Path] = []
    for path in sorted(set(paths)):
        if not any(path.is_relative_to(outer) for outer in roots):
            roots.append(path)
    return roots


def idle_command() -> list[str]:
    """Return a command that sleeps forever. Raises DockerError if this machine has no such command."""
    sleep = shutil.which("sleep")
    if sleep is None:
        raise DockerError("sleep(1) is not on PATH, and containers that hold a network run it: install coreutils")
    return [sleep, "infinity"]
