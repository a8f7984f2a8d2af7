"""Write the mission files of all agents, and a manifest that describes them (`ucp-mission-manifest/1`).

The mission files are like those that a run gives to its agents (`harness.play.process.agent_mission`), with some
differences for real flights. They have no speedup and no quirks. Each vehicle has an address in the user's network.
Each agent keeps a store, so that a power failure loses no data. Each file is parsed by the agent's own parser before it
is written.
"""

import hashlib
import ipaddress
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.exports import AgentId, Hash
from harness.errors import HarnessError, MachineError, RunDirectoryError
from harness.play.process.agent_mission import NO_QUIRKS, mission_file
from harness.scenario import Scenario
from harness.scenario.strict_model import VehicleKey
from netem.addresses import BROADCAST, address
from ucp.agent_files import write_json_atomically
from ucp.block import MAX_EVENT_DATA_BYTES, InceptionBlock, hash_digest
from ucp.features import needed_features
from ucp.messages import PORT
from ucp.mission import MAX_INITIAL_DATA_BYTES, Mission, MissionError, parse_mission
from ucp.sealed import SEAL_BYTES, sealed_to
from ucp.settings import Settings

FILE = "manifest.json"
EXACT = 2**53
"""The largest integer n for which a float can represent every integer from 0 to n exactly."""


class ManifestInception(BaseModel):
    """The block hash BH_0 (eq. 3.3) and the chain hash CH_0 (eq. 3.4) of the inception block."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    block_hash: Hash
    chain_hash: Hash

    @classmethod
    def of(cls, initial_data: bytes) -> "ManifestInception":
        inception = InceptionBlock(initial_data)
        return cls(block_hash=inception.block_hash.hex(), chain_hash=inception.chain_hash.hex())


class Manifest(BaseModel):
    """The manifest of a mission. `files` maps each agent ID to the mission file of the agent, which is in the same
    directory. `settings_sha256` is the SHA-256 hash of the settings.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    schema_: Annotated[Literal["ucp-mission-manifest/1"], Field(alias="schema")] = "ucp-mission-manifest/1"
    name: str
    roster: list[AgentId]
    inception: ManifestInception
    settings_sha256: Hash
    broadcast: str
    port: Annotated[int, Field(ge=1, le=65535)]
    files: dict[VehicleKey, str]

    def to_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", by_alias=True)


def fingerprint(settings: Settings) -> str:
    """Return the SHA-256 hash of the settings as JSON with sorted keys, without spaces, and with integers as floats."""
    values = {
        name: float(value) if type(value) is int and value < EXACT else value
        for name, value in settings.to_json().items()
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


SUFFIX = ".mission.json"


class MissionFileError(HarnessError):
    """An error: agents would not accept the requested mission."""


@dataclass(frozen=True)
class MissionPlan:
    """The plan of a mission before it is written."""

    scenario: Scenario
    initial_data: bytes
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Values that replace single settings of the scenario."""
    events: Mapping[str, Any] = field(default_factory=dict)
    """Values that replace single values in the section `events` of each mission file."""
    subnet: ipaddress.IPv4Network | None = None
    """The network from which the addresses of vehicles without an entry in `addresses` are computed. If it is None,
    these vehicles have the same addresses as in a run (`netem.addresses`).
    """
    addresses: Mapping[int, str] = field(default_factory=dict)
    broadcast: str | None = None
    """The broadcast address. If it is None, the mission has the broadcast address of `subnet`. Without `subnet`, the
    mission has the same broadcast address as a run.
    """
    port: int = PORT
    secured: bool = False
    """True if the directory of each mission file also contains the key bundle of the vehicle."""

    def documents(self) -> dict[int, dict[str, Any]]:
        """Return the mission file of each agent. Raises MissionFileError."""
        if len(self.initial_data) > MAX_INITIAL_DATA_BYTES:
            raise MissionFileError(
                f"the initial data is {len(self.initial_data)} bytes: the maximum is {MAX_INITIAL_DATA_BYTES}"
            )
        unknown_ids = sorted(self.addresses.keys() - {*self.scenario.roster})
        if unknown_ids:
            raise MissionFileError(f"`--address` names vehicle {unknown_ids[0]}, which is not on the roster")
        documents = {agent_id: self._document(agent_id) for agent_id in self.scenario.roster}
        vehicles: dict[str, int] = {}
        for agent_id, document in documents.items():
            vehicle_address = document["network"]["address"]
            other = vehicles.setdefault(vehicle_address, agent_id)
            if other != agent_id:
                raise MissionFileError(
                    f"vehicles {other} and {agent_id} have the same address {vehicle_address}: choose "
                    "another `--address` for one of them"
                )
        return documents

    def _document(self, agent_id: int) -> dict[str, Any]:
        document = mission_file(
            agent_id,
            self.scenario,
            int.from_bytes(hash_digest(self.initial_data)[:8], "big"),
            self.initial_data,
            address=self._address(agent_id),
            broadcast=self.broadcast or (str(self.subnet.broadcast_address) if self.subnet else BROADCAST),
            with_vehicle=True,
            store=f"{agent_id}.store",
        )
        document |= {"quirks": dict(NO_QUIRKS), "speedup": 1.0}
        document["network"]["port"] = self.port
        if self.secured:
            document["security"] = {"bundle": f"{agent_id}.bundle.json"}
        if sealed_to(self.initial_data) is not None:
            document["settings"]["max_block_bytes"] = MAX_EVENT_DATA_BYTES - SEAL_BYTES
        document["settings"].update(self.settings)
        document["events"].update(self.events)
        document["features"] = needed_features(document)
        try:
            parse_mission(document)
        except MissionError as error:
            raise MissionFileError(f"agent {agent_id}: {error}") from None
        return document

    def _address(self, agent_id: int) -> str:
        if agent_id in self.addresses:
            return self.addresses[agent_id]
        if self.subnet is None:
            return address(agent_id)
        if not 0 < agent_id < self.subnet.num_addresses - 1:
            raise MissionFileError(
                f"vehicle {agent_id} has no address in {self.subnet}: choose a wider `--subnet`, or give "
                f"`--address {agent_id}=...`"
            )
        return str(self.subnet[agent_id])


def write(plan: MissionPlan, directory: Path, *, overwrite: bool = False) -> list[Path]:
    """Write the mission files and the manifest. Return their paths, the path of the manifest last. Raises
    MissionFileError, or MachineError on a disk error. Raises RunDirectoryError if a file exists and `overwrite` is
    false, or if the directory contains other mission files.
    """
    documents = {f"{agent_id}{SUFFIX}": document for agent_id, document in plan.documents().items()}
    missions = {name: parse_mission(document) for name, document in documents.items()}
    files = {**documents, FILE: manifest(plan.scenario.name, missions).to_json()}
    _check_overwrite(directory, list(files), overwrite)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, document in files.items():
            write_json_atomically(directory / name, document)
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}; choose another --out") from None
    return [directory / name for name in files]


def manifest(name: str, missions: Mapping[str, Mission]) -> Manifest:
    """Return the manifest that describes these mission files. `missions` maps the name of each mission file to its
    content, and contains at least one file.
    """
    first = next(iter(missions.values()))
    return Manifest(
        name=name,
        roster=sorted(first.roster),
        inception=ManifestInception.of(first.initial_data),
        settings_sha256=fingerprint(first.settings),
        broadcast=first.network.broadcast,
        port=first.network.port,
        files={mission.agent_id: file for file, mission in missions.items()},
    )


def _check_overwrite(directory: Path, names: Sequence[str], overwrite: bool) -> None:
    existing = [name for name in names if (directory / name).exists()]
    if existing and not overwrite:
        raise RunDirectoryError(
            f"{directory / existing[0]} exists: choose another --out, or replace it with --overwrite"
        )
    stale = sorted(path.name for path in directory.glob(f"*{SUFFIX}") if path.name not in names)
    if stale:
        raise RunDirectoryError(
            f"{directory / stale[0]} belongs to another mission, because its agent is not on this roster: move it "
            "away, or choose another --out"
        )
