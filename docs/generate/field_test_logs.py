"""Play field_test_logs.yaml, damage the records of the run as on real flights, and write them into a new directory.

    python docs/generate/field_test_logs.py logs

The same scenario and seed give the same bytes, until a change of the code changes runs in virtual time.
"""

import gzip
import sys
import tempfile
from pathlib import Path

from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.scenario import Scenario, load_scenario

SCENARIO = Path(__file__).with_suffix(".yaml")
SEED = 76
HOVER_TEST = {"name": "Hover test in the morning", "agents": [10, 28, 32, 118, 120, 122], "duration_s": 120}
NOTES = "Camp Roberts, 2nd UCP test. Wind 250/8. 122 landed first, batteries swapped at 14:40.\n"


def broken() -> dict[str, bytes]:
    """Return the damaged files of six vehicles, by file name."""
    with tempfile.TemporaryDirectory() as scratch:
        flight = _flown(load_scenario(SCENARIO), Path(scratch) / "flight")
        before = _flown(Scenario.model_validate(HOVER_TEST), Path(scratch) / "before")
    del flight["122.chain.json"]
    whole = flight.pop("28.trace.jsonl")
    flight["28.trace.jsonl.gz"] = gzip.compress(whole, mtime=0)
    flight["32.trace.jsonl"] = flight["32.trace.jsonl"][:-100_000]
    flight["118.trace.jsonl"] = before["118.trace.jsonl"] + flight["118.trace.jsonl"]
    flight["backup/120.trace.jsonl"] = flight["120.trace.jsonl"]
    sector = flight["10.trace.jsonl"].index(b"\n", 900_000) + 1000
    flight["10.trace.jsonl"] = flight["10.trace.jsonl"][:sector] + bytes(512) + flight["10.trace.jsonl"][sector + 512 :]
    return {**flight, "notes.txt": NOTES.encode(), "camera/DSC_0042.JPG": b"\xff\xd8\xff\xe0" + bytes(range(256)) * 16}


def _flown(scenario: Scenario, directory: Path) -> dict[str, bytes]:
    run(scenario, SEED, directory, SilentProgress(), "sim")
    files = (path for kind in ("*.trace.jsonl", "*.chain.json") for path in (directory / "agents").glob(kind))
    return {path.name: path.read_bytes() for path in files}


def main(directory: Path) -> None:
    for name, content in broken().items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
