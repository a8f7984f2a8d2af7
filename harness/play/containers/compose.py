"""Write a Docker Compose file with the vehicles and agents of a scenario, so that a user can start them by hand,
without the harness. A directory beside the file contains the mission files and the build context of the image. Docker
builds the network, so the swarm has no network conditions and no faults. In all other respects, the containers equal
those of the Docker backend.
"""

import os
import sys
from pathlib import Path
from typing import Any

import yaml

from harness.archive.directory import PUBLIC_KEYS_FILE
from harness.errors import RunDirectoryError, ScenarioError
from harness.play._vehicle_keys import FRESH, FRESH_BYTES, MissionKeys, mission_keys
from harness.play.containers import _images, ownership
from harness.play.containers._container_backend import DockerBackend
from harness.play.containers._container_preflight import check_debuggers
from harness.play.containers._images import ContainerImage
from harness.play.process.agent_mission import mission_file
from harness.scenario import Scenario
from netem import addresses
from sitl.vehicle import VehicleKind
from ucp.agent_files import write_json_atomically

INSIDE = "/ucp"
"""Path inside each container at which Docker mounts the directory beside the compose file."""
SECRETS = "/run/secrets"
"""Directory inside a container in which Docker Compose places secret files."""

TOP = """\
# {name}: {count} agents{vehicles}, to start by hand and look inside:
#
#   docker compose -f {file} up
#
# The network is Docker's, and perfect: no loss, no partition, no timeline{grounded}.
# Mission time runs {speedup:g} times as fast as the clock, from the moment at which the service `start` has found all
# agents ready. The agents' files are in {directory}/agents; when they have been stopped,
# ucp-harness check {directory}/agents/*.chain.json judges the chains.{secured}
"""
SECURED = """
# Each agent reads its own bundle where it lies, and cannot write there: what epochs leave behind is not erased."""


def write_compose(
    scenario: Scenario, seed: int, kinds: dict[int, VehicleKind], system_ids: dict[int, int], file: Path
) -> Path:
    """Write the Compose file `file`, and a directory beside it. Return the directory.

    Raises RunDirectoryError if the file or the directory exists already.
    """
    keys = _keys(scenario)
    if scenario.gcs:
        raise ScenarioError(
            "`gcs` does not work with --emit-compose, because a compose file has no run: leave out one of them"
        )
    check_debuggers(scenario)
    folder = file.with_suffix("")
    for path in (file, folder):
        if path.exists():
            raise RunDirectoryError(f"{path} exists: choose another name; existing files are not overwritten")
    try:
        (folder / "agents").mkdir(parents=True)
        services = _services(scenario, seed, kinds, system_ids, folder, keys)
        document = {"services": services, "networks": {"air": _network()}, **_secrets(scenario, keys)}
        top = TOP.format(
            name=scenario.name.replace("\n", " "),
            count=len(scenario.roster),
            vehicles=" on their vehicles" if kinds else "",
            grounded="; and the vehicles have no pilot" if kinds else "",
            file=file.name,
            directory=folder.name,
            speedup=scenario.speedup,
            secured=SECURED if keys else "",
        )
        file.write_text(top + yaml.safe_dump(document, sort_keys=False, width=120), encoding="utf-8")
    except OSError as error:
        raise RunDirectoryError(f"{error.filename or file} cannot be written: {error.strerror}") from None
    return folder


def _keys(scenario: Scenario) -> MissionKeys | None:
    """Return the mission keys from the user's key directory. Return None for a mission without keys. Raises
    ScenarioError if the scenario names no such directory, or if a key file is missing, because the compose file
    contains no keys.
    """
    if scenario.security is None:
        return None
    bundles = [Path(scenario.security.keys) / _bundle(vehicle) for vehicle in scenario.roster]
    if scenario.security.keys == FRESH or not all(bundle.exists() for bundle in bundles):
        raise ScenarioError(
            "`security.keys`: a compose file needs key bundles in a directory, because it holds no keys itself: write "
            "them with `ucp-harness keys bundle HOME --out bundles`, and set {keys: bundles}"
        )
    return mission_keys(scenario, bytes(FRESH_BYTES))


def _secrets(scenario: Scenario, keys: MissionKeys | None) -> dict[str, object]:
    """Return the keys of all vehicles as Compose secrets. Each agent can read only its own keys."""
    if keys is None or scenario.security is None:
        return {}
    directory = Path(scenario.security.keys).absolute()
    return {"secrets": {_bundle(vehicle): {"file": str(directory / _bundle(vehicle))} for vehicle in keys.bundles}}


def _bundle(vehicle: int) -> str:
    return f"{vehicle}.bundle.json"


def _network() -> dict[str, object]:
    subnet = f"{addresses.NETWORK}/{addresses.PREFIX_LENGTH}"
    return {"driver": "bridge", "internal": True, "ipam": {"config": [{"subnet": subnet}]}}


def _services(
    scenario: Scenario,
    seed: int,
    kinds: dict[int, VehicleKind],
    system_ids: dict[int, int],
    folder: Path,
    keys: MissionKeys | None,
) -> dict[str, object]:
    ours, build = _our_image(scenario, folder)
    docker = scenario.docker.image
    in_named = set(_images.agents_in_named(scenario))
    services: dict[str, Any] = {}
    initial_data = f"{scenario.name}, seed {seed}, by hand".encode()
    if keys is not None:
        initial_data = keys.add_depot_key(initial_data)
        write_json_atomically(folder / "agents" / PUBLIC_KEYS_FILE, keys.public.to_json())
    for number, vehicle in enumerate(scenario.roster):
        mission = f"{vehicle}.mission.json"
        write_json_atomically(
            folder / "agents" / mission,
            mission_file(
                vehicle,
                scenario,
                seed,
                initial_data,
                address=addresses.address(vehicle),
                broadcast=addresses.BROADCAST,
                with_vehicle=bool(kinds),
                bundle=f"{SECRETS}/{_bundle(vehicle)}" if keys else None,
            ),
        )
        network: dict[str, Any] = {"networks": {"air": {"ipv4_address": addresses.address(vehicle)}}}
        if kinds:
            directory = folder / "vehicles" / str(vehicle)
            directory.mkdir(parents=True)
            home = scenario.vehicles.home_of(vehicle, number)
            launch = kinds[vehicle].launch(system_ids[vehicle], home, scenario.speedup, directory)
            name = f"vehicle-{vehicle}"
            services[name] = _service(scenario, ours, launch.argv, f"vehicles/{vehicle}", folder) | build | network
            services[name] |= {"environment": dict(launch.env)} if launch.env else {}
            network = {"network_mode": f"service:{name}", "depends_on": [name]}
        argv = [*DockerBackend().agent_command(scenario, vehicle), mission]
        image = ContainerImage(str(docker), "python3", foreign=True) if vehicle in in_named else ours
        services[f"agent-{vehicle}"] = _service(scenario, image, argv, "agents", folder) | network
        services[f"agent-{vehicle}"] |= {} if vehicle in in_named else build
        services[f"agent-{vehicle}"] |= {"secrets": [_bundle(vehicle)]} if keys else {}
    waits = {"network_mode": "none", "depends_on": [f"agent-{vehicle}" for vehicle in scenario.roster]}
    (folder / "start.py").write_bytes(Path(__file__).with_name("start.py").read_bytes())
    argv = [sys.executable, f"{INSIDE}/start.py", f"{INSIDE}/agents"]
    services["start"] = _service(scenario, ours, argv, "agents", folder) | build | waits
    return services


def _our_image(scenario: Scenario, folder: Path) -> tuple[ContainerImage, dict[str, Any]]:
    """Return the settings of this project's image for the Compose file, with the section from which Docker builds the
    image.
    """
    context = folder / "image"
    context.mkdir()
    if scenario.docker.image_from_host:
        image = _images.host_image()
        (context / "Dockerfile").write_text(f"FROM scratch\nLABEL {ownership.PROJECT}=host\n", encoding="utf-8")
        return image, {"build": f"./{folder.name}/image"}
    for name, content in _images.context().items():
        (context / name).parent.mkdir(parents=True, exist_ok=True)
        (context / name).write_bytes(content)
    build = {"context": f"./{folder.name}/image", "network": "host", "args": _images.build_arguments()}
    return ContainerImage(_images.project_name(), "python3"), {"build": build}


def _service(
    scenario: Scenario, image: ContainerImage, argv: list[str], directory: str, folder: Path
) -> dict[str, object]:
    command = image.command(argv)
    docker = scenario.docker
    service: dict[str, Any] = {
        "image": image.name,
        "entrypoint": command[:1],
        "command": command[1:],
        "working_dir": f"{INSIDE}/{directory}",
        "user": f"{os.getuid()}:{os.getgid()}",
        "volumes": [f"./{folder.name}:{INSIDE}", *(f"{path}:{path}:ro" for path in image.shared(argv))],
        "tmpfs": ["/tmp"],  # noqa: S108  (inside the container)
        "read_only": True,
        "init": True,
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges"],
    }
    limits = {
        "mem_limit": None if docker.memory_mib is None else f"{docker.memory_mib}m",
        "cpus": docker.cpus,
        "pids_limit": docker.pids,
    }
    return service | {key: value for key, value in limits.items() if value is not None}
