"""Write the JSON schemas of all documents that other programs read and write.

Pydantic generates the schemas of the harness from its models. `ucp.contract.schemas` builds the schemas of the agent
contract. The repository does not contain the schemas, because this program can generate them.
`tests/harness/schemas.sha256` has their digests. The wheel and the site contain the schemas as files. To write them
into a folder:

    python -m docs.generate.json_schemas FOLDER
"""

import json
import sys
from pathlib import Path

from pydantic import BaseModel

from harness.archive.exports import Export
from harness.archive.packets.packets_document import PacketsRecord
from harness.archive.run_record import RunRecord
from harness.field.adapters.imported_records import ImportRecord
from harness.field.depot.mission_files import Manifest
from harness.field.depot.record_lines import ConsolidatedLine
from harness.field.replay.replay_document import ReplayDocument
from harness.scenario import Scenario
from harness.sweep.matrix import MatrixRecord
from ucp.contract import schemas

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
}


def generate(name: str) -> dict[str, object]:
    """Return the JSON schema with this name, which is a key of `MODELS`."""
    schema = MODELS[name].model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def texts() -> dict[str, str]:
    """Return the text of each JSON schema. The keys are the paths of the schemas in the installed package."""
    documents = {f"harness/schemas/{name}.schema.json": generate(name) for name in MODELS}
    documents |= {f"ucp/contract/schemas/{name}.schema.json": schemas.generate(name) for name in schemas.DOCUMENTS}
    return {path: json.dumps(document, indent=1) + "\n" for path, document in documents.items()}


def write_all(folder: Path) -> None:
    """Write every JSON schema below `folder`, at its path in the installed package."""
    for path, text in texts().items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m docs.generate.json_schemas FOLDER")
    write_all(Path(sys.argv[1]))
