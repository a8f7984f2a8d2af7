"""A compose file with the vehicles and agents of a scenario, to start them by hand and look inside.

It stands alone: beside it lies a directory with the mission files, and with what the image is built from. Docker
builds the network, so there are no conditions and no faults, and the containers are the same otherwise.
"""

import os
import sys
from pathlib import Path
from typing import Any

import yaml

from harness.archive.directory import PUBLIC_KEYS_FILE
from harness.errors import RunDirectoryError, ScenarioError
from harness.play._vehicle_keys import FRESH, FRESH_BYTES, MissionKeys, keys_of
from harness.play.containers import _images, ownership
from harness.play.containers._container_backend import Containers
from harness.play.containers._container_preflight import refuse_debuggers_that_are_not_in_the_image
from harness.play.containers._images import Image
from harness.play.process.agent_mission import mission_file
from harness.scenario import Scenario
from netem import addresses
from sitl.vehicle import VehicleKind
from ucp.agent_files import write_json_atomically

INSIDE = "/ucp"
"""Where the directory beside the compose file is in every container."""
SECRETS = "/run/secrets"
"""Where compose puts the files that only some containers see."""

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
    """Write `file` and the directory beside it, which is returned. Raises RunDirectoryError if one is there already."""
    keys = _keys(scenario)
    if scenario.gcs:
        raise ScenarioError(
            "`gcs` does not work with --emit-compose, because a compose file has no run: leave out one of them"
        )
    refuse_debuggers_that_are_not_in_the_image(scenario)
    beside = file.with_suffix("")
    for path in (file, beside):
        if path.exists():
            raise RunDirectoryError(f"{path} exists: choose another name; existing files are not overwritten")
    try:
        (beside / "agents").mkdir(parents=True)
        services = _services(scenario, seed, kinds, system_ids, beside, keys)
        document = {"services": services, "networks": {"air": _network()}, **_secrets(scenario, keys)}
        top = TOP.format(
            name=scenario.name.replace("\n", " "),
            count=len(scenario.roster),
            vehicles=" on their vehicles" if kinds else "",
            grounded="; and the vehicles have no pilot" if kinds else "",
            file=file.name,
            directory=beside.name,
            speedup=scenario.speedup,
            secured=SECURED if keys else "",
        )
        file.write_text(top + yaml.safe_dump(document, sort_keys=False, width=120), encoding="utf-8")
    except OSError as error:
        raise RunDirectoryError(f"{error.filename or file} cannot be written: {error.strerror}") from None
    return beside


def _keys(scenario: Scenario) -> MissionKeys | None:
    """Those of the bundles that the user handed out, which stay where they are; None of a mission that has none."""
    if scenario.security is None:
        return None
    bundles = [Path(scenario.security.keys) / _bundle(vehicle) for vehicle in scenario.roster]
    if scenario.security.keys == FRESH or not all(bundle.exists() for bundle in bundles):
        raise ScenarioError(
            "`security.keys`: a compose file needs key bundles in a directory, because it holds no keys itself: write "
            "them with `ucp-harness keys bundle HOME --out bundles`, and set {keys: bundles}"
        )
    return keys_of(scenario, bytes(FRESH_BYTES))


def _secrets(scenario: Scenario, keys: MissionKeys | None) -> dict[str, Any]:
    """Each vehicle's bundle, which compose shows to its agent alone, and to nobody for writing."""
    if keys is None or scenario.security is None:
        return {}
    directory = Path(scenario.security.keys).absolute()
    return {"secrets": {_bundle(vehicle): {"file": str(directory / _bundle(vehicle))} for vehicle in keys.bundles}}


def _bundle(vehicle: int) -> str:
    return f"{vehicle}.bundle.json"


def _network() -> dict[str, Any]:
    subnet = f"{addresses.NETWORK}/{addresses.PREFIX_LENGTH}"
    return {"driver": "bridge", "internal": True, "ipam": {"config": [{"subnet": subnet}]}}


def _services(
    scenario: Scenario,
    seed: int,
    kinds: dict[int, VehicleKind],
    system_ids: dict[int, int],
    beside: Path,
    keys: MissionKeys | None,
) -> dict[str, Any]:
    ours, build = _our_image(scenario, beside)
    asked = scenario.docker.image
    in_named = set(_images.agents_in_named(scenario))
    services: dict[str, Any] = {}
    initial_data = f"{scenario.name}, seed {seed}, by hand".encode()
    if keys is not None:
        initial_data = keys.sealed_to_depot(initial_data)
        write_json_atomically(beside / "agents" / PUBLIC_KEYS_FILE, keys.public.to_json())
    for number, vehicle in enumerate(scenario.roster):
        mission = f"{vehicle}.mission.json"
        write_json_atomically(
            beside / "agents" / mission,
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
            directory = beside / "vehicles" / str(vehicle)
            directory.mkdir(parents=True)
            home = scenario.vehicles.home_of(vehicle, number)
            launch = kinds[vehicle].launch(system_ids[vehicle], home, scenario.speedup, directory)
            name = f"vehicle-{vehicle}"
            services[name] = _service(scenario, ours, launch.argv, f"vehicles/{vehicle}", beside) | build | network
            services[name] |= {"environment": dict(launch.env)} if launch.env else {}
            network = {"network_mode": f"service:{name}", "depends_on": [name]}
        argv = [*Containers().agent_command(scenario, vehicle), mission]
        image = Image(str(asked), "python3", foreign=True) if vehicle in in_named else ours
        services[f"agent-{vehicle}"] = _service(scenario, image, argv, "agents", beside) | network
        services[f"agent-{vehicle}"] |= {} if vehicle in in_named else build
        services[f"agent-{vehicle}"] |= {"secrets": [_bundle(vehicle)]} if keys else {}
    waits = {"network_mode": "none", "depends_on": [f"agent-{vehicle}" for vehicle in scenario.roster]}
    (beside / "start.py").write_bytes(Path(__file__).with_name("start.py").read_bytes())
    argv = [sys.executable, f"{INSIDE}/start.py", f"{INSIDE}/agents"]
    services["start"] = _service(scenario, ours, argv, "agents", beside) | build | waits
    return services


def _our_image(scenario: Scenario, beside: Path) -> tuple[Image, dict[str, Any]]:
    """The image, and how compose gets it: from a directory beside the file."""
    context = beside / "image"
    context.mkdir()
    if scenario.docker.image_from_host:
        image = _images.host_image()
        (context / "Dockerfile").write_text(f"FROM scratch\nLABEL {ownership.PROJECT}=host\n", encoding="utf-8")
        return image, {"build": f"./{beside.name}/image"}
    for name, content in _images.context().items():
        (context / name).parent.mkdir(parents=True, exist_ok=True)
        (context / name).write_bytes(content)
    build = {"context": f"./{beside.name}/image", "network": "host", "args": _images.build_arguments()}
    return Image(_images.project_name(), "python3"), {"build": build}


def _service(scenario: Scenario, image: Image, argv: list[str], directory: str, beside: Path) -> dict[str, Any]:
    command = image.command(argv)
    asked = scenario.docker
    service: dict[str, Any] = {
        "image": image.name,
        "entrypoint": command[:1],
        "command": command[1:],
        "working_dir": f"{INSIDE}/{directory}",
        "user": f"{os.getuid()}:{os.getgid()}",
        "volumes": [f"./{beside.name}:{INSIDE}", *(f"{path}:{path}:ro" for path in image.shared(argv))],
        "tmpfs": ["/tmp"],  # noqa: S108  (the container's own)
        "read_only": True,
        "init": True,
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges"],
    }
    limits = {
        "mem_limit": None if asked.memory_mib is None else f"{asked.memory_mib}m",
        "cpus": asked.cpus,
        "pids_limit": asked.pids,
    }
    return service | {key: value for key, value in limits.items() if value is not None}
