"""JSON Schemas of the formats that others read and write, as pydantic generates them.

`python -m harness.schemas` writes them anew after a change; a test fails while they are behind.
"""

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from harness.archive.exports import Export
from harness.archive.packets.packets_document import PacketsRecord
from harness.archive.run_record import RunRecord
from harness.field.adapters.written_records import ImportRecord
from harness.field.depot.mission_files import Manifest
from harness.field.depot.record_lines import ConsolidatedLine
from harness.field.replay.replay_document import ReplayDocument
from harness.scenario import Scenario
from harness.sweep.matrix import MatrixRecord
from harness.sweep.scale import ScaleRecord

DIRECTORY = Path(__file__).parent
MODELS: dict[str, type[BaseModel]] = {
    "scenario": Scenario,
    "ucp-chain-export-1": Export,
    "ucp-consolidated-1": ConsolidatedLine,
    "ucp-import-1": ImportRecord,
    "ucp-matrix-1": MatrixRecord,
    "ucp-mission-manifest-1": Manifest,
    "ucp-packets-1": PacketsRecord,
    "ucp-replay-1": ReplayDocument,
    "ucp-run-1": RunRecord,
    "ucp-scale-1": ScaleRecord,
}


def path(name: str) -> Path:
    return DIRECTORY / f"{name}.schema.json"


def generate(name: str) -> dict[str, Any]:
    schema = MODELS[name].model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def write_all() -> None:
    for name in MODELS:
        path(name).write_text(json.dumps(generate(name), indent=1) + "\n", encoding="utf-8")
