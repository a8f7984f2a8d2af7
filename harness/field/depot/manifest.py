"""The manifest of a mission, `ucp-mission-manifest/1`: in a few lines what every vehicle must carry alike."""

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from harness.archive.exports import AgentId, Hash
from harness.scenario.strict_model import VehicleKey
from ucp.block import InceptionBlock
from ucp.settings import Settings

FILE = "manifest.json"
EXACT = 2**53
"""Whole numbers up to here are floats as well."""


class ManifestInception(BaseModel):
    """BH_0 and CH_0 (eq. 3.3 and 3.4)."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    block_hash: Hash
    chain_hash: Hash

    @classmethod
    def of(cls, initial_data: bytes) -> "ManifestInception":
        inception = InceptionBlock(initial_data)
        return cls(block_hash=inception.block_hash.hex(), chain_hash=inception.chain_hash.hex())


class Manifest(BaseModel):
    """`files` are the mission files by agent ID, beside the manifest; `settings_sha256` is `fingerprint`'s."""

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
    """SHA-256 of the settings as JSON: keys in order, no spaces, and 10 written as 10.0 is."""
    known = {
        name: float(value) if type(value) is int and value < EXACT else value for name, value in settings.told().items()
    }
    return hashlib.sha256(json.dumps(known, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
