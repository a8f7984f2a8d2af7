"""Fuzz target: a chain export. The reader refuses it in one sentence, or the writer reproduces it and it can be merged
with other exports.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.archive.exports import read_export
from harness.errors import HarnessError
from tests.fuzz.finding import require, sound
from tests.fuzz.targets.home import came_home, in_its_run

NAME = "1.chain.json"


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / NAME
        path.write_bytes(data)
        try:
            export = read_export(path)
        except HarnessError as error:
            sound(str(error))
        else:
            path.write_text(export.model_dump_json(by_alias=True))
            require(read_export(path) == export, "an export is written otherwise")
            for block in export.blocks():
                _ = block.event_bytes
    came_home(NAME, data)
    in_its_run(f"agents/{NAME}", data)


def seeds(flown: Path) -> Iterator[bytes]:
    yield (flown / "agents" / NAME).read_bytes()
