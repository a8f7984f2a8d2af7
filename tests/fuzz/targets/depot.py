"""Fuzz target: a chain export, mission file or manifest. The target merges the file with other files and compares
them.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import consolidate
from harness.field.depot.mission_comparison import compare
from harness.field.depot.mission_files import MissionPlan, write
from harness.field.depot.record_outputs import in_words, lines, table, tracks
from tests.fuzz.finding import sound
from tests.fuzz.targets.home import sound_run
from tests.harness.virtual import scenario

_NAMES = {b'"ucp-mission-manifest': "manifest.json", b'"ucp-mission/': "1.mission.json"}


def run(data: bytes) -> None:
    name = next((name for schema, name in _NAMES.items() if schema in data[:200]), "1.chain.json")
    with TemporaryDirectory() as directory:
        path = Path(directory) / name
        path.write_bytes(data)
        beside = sound_run() / "agents" / "2.chain.json"
        for paths in ([path], [path, beside]):
            _consolidate(paths)
            comparison = compare(paths)
            json.dumps(comparison.to_json())
            for difference in comparison.differences:
                sound(difference.sentence)
            if comparison.verdict == "same":
                sound(comparison.in_words())


def _consolidate(paths: list[Path]) -> None:
    try:
        record = consolidate(collect_exports(paths))
    except HarnessError as error:
        sound(str(error))
        return
    for sentence in (
        *record.collected.problems,
        *record.collected.left_out,
        *record.collected.remarks,
        *in_words(record, None),
    ):
        sound(sentence)
    for line in "".join(lines(record)).splitlines():
        json.loads(line)
    table(record)
    tracks(record)


def seeds(flown: Path) -> Iterator[bytes]:
    yield (flown / "agents" / "1.chain.json").read_bytes()
    with TemporaryDirectory() as directory:
        for path in write(MissionPlan(scenario(agents=3), b"fuzz"), Path(directory)):
            if path.name in _NAMES.values():
                yield path.read_bytes()
