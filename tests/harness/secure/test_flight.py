"""Play a secured flight. Test every command that reads runs on the records of this flight. The flight has encrypted
events, packet captures and an excluded vehicle.

Each command prints correct results with and without keys, and never a secret.
"""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from harness.play.keyring.key_directory import KeyDirectory
from tests.harness.command import harness
from tests.harness.secure.secrets import leaks, left_in, secrets

ROSTER = [1, 2, 3]
SCENARIO = {
    "name": "flight",
    "agents": ROSTER,
    "duration_s": 150,
    "capture": True,
    "events": {"source": "random", "mean_s": 6},
    "network": {"loss": 0.1},
    "timeline": [
        {"at_s": 70, "forge": {"message": "Commit Block", "sender": 3}},
        {"at_s": 80, "forge": {"message": "Commit Block", "sender": 2}},
        {"at_s": 90, "kill": [3]},
        {"at_s": 95, "revoke": [3], "heard_by": [1]},
        {"at_s": 120, "forge": {"message": "Commit Block", "sender": 3}},
    ],
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> KeyDirectory:
    home = KeyDirectory.new(tmp_path_factory.mktemp("flight") / "keys", ROSTER, seals=True, epoch_s=60.0)
    home.write_bundles(home.directory.parent / "bundles")
    return home


@pytest.fixture(scope="module")
def flown(home: KeyDirectory) -> Path:
    """Play the secured flight, and return its run directory."""
    directory = home.directory.parent
    security = {"keys": str(home.directory), "seal": True, "captured": 3}
    (directory / "flight.yaml").write_text(json.dumps({**SCENARIO, "security": security}))
    done = harness("run", directory / "flight.yaml", "--backend", "sim", "--seed", "1", "--out", directory / "run")
    assert done.returncode == 1, done.stdout + done.stderr
    return directory / "run"


@pytest.fixture
def keys(home: KeyDirectory) -> list[str]:
    return ["--bundle", str(home.directory.parent / "bundles/1.bundle.json"), "--depot-key", str(home.directory)]


FORGED = "which agent 3 never completed, although the block is signed with its key, so its key is known to others"
SEALED = "sealed to the depot"
COMMANDS: list[tuple[Sequence[str], int, str]] = [
    (("check", "RUN"), 1, FORGED),
    (("report", "RUN"), 0, "report.html"),
    (("replay", "RUN"), 0, "no difference"),
    (("validate", "RUN"), 0, "as specified"),
    (("chain", "RUN", "--decode"), 0, SEALED),
    (("chain", "RUN", "--decode", "--depot-key", "HOME"), 0, "not sealed to this depot by the agent that it names"),
    (("consolidate", "RUN", "--out", "OUT.jsonl"), 0, SEALED),
    (("consolidate", "RUN", "--out", "OUT.jsonl", "--depot-key", "HOME"), 0, "1 block not opened by this key"),
    (("packets", "RUN"), 0, "a revocation of keys"),
    (("packets", "RUN", "--bundle", "BUNDLE"), 0, "not signed by its sender"),
    (("packets", "RUN", "--follow", "1.1"), 2, "--bundle shows what is sealed"),
    (("packets", "RUN", "--follow", "1.1", "--bundle", "BUNDLE"), 0, "approve block 1.1"),
    (("export", "RUN", "--mcap", "OUT"), 0, "event data is sealed to the depot: positions need --depot-key"),
    (("export", "RUN", "--perfetto", "OUT", "--depot-key", "HOME"), 0, "events"),
    (("import", "RUN", "--out", "OUT"), 0, "3 trace(s)"),
    (("bisect", "--once", "RUN"), 0, "characteristic 4 violated"),
    (("reconstruct", "RUN", "--out", "OUT"), 0, "reproduces all 3 chains"),
]


@pytest.mark.parametrize(
    ("command", "status", "words"), COMMANDS, ids=lambda it: it[0] if isinstance(it, tuple) else ""
)
def test_command_prints_the_expected_words_and_no_secret(
    home: KeyDirectory, flown: Path, tmp_path: Path, command: Sequence[str], status: int, words: str
) -> None:
    bundle = str(home.directory.parent / "bundles/1.bundle.json")
    places = {
        "RUN": str(flown),
        "HOME": str(home.directory),
        "BUNDLE": bundle,
        "OUT": str(tmp_path / "out"),
        "OUT.jsonl": str(tmp_path / "out.jsonl"),
    }
    done = harness(*(places.get(word, word) for word in command))
    said = " ".join((done.stdout + done.stderr).split())
    assert (done.returncode, words in said) == (status, True), said
    left = [("its output", (done.stdout + done.stderr).encode()), *left_in(tmp_path), *left_in(flown)]
    assert leaks(secrets(home, 12), left) == []


def test_reconcile_at_the_depot_keeps_block_signatures(flown: Path, tmp_path: Path) -> None:
    done = harness("consolidate", flown, "--out", tmp_path / "record.jsonl", "--reconcile")
    assert done.returncode == 0, done.stderr
    judged = json.loads(harness("check", tmp_path / "record.reconciled", "--json", "--keys", flown).stdout)
    genuine = judged["characteristics"]["4"]
    assert (genuine["verdict"], genuine["evidence"]) == ("not applicable", [])
    assert genuine["reason"].startswith("unsigned: the exports of agents 1 and 2 have no signed head"), genuine


def brought_home(flown: Path, directory: Path) -> Path:
    """Copy exports and packet captures of a run, without its traces."""
    directory.mkdir()
    for path in (*flown.glob("agents/*.chain.json"), *flown.glob("capture/*")):
        shutil.copy(path, directory)
    return directory


def test_captures_alone_are_flown_again_with_keys(home: KeyDirectory, tmp_path: Path, keys: list[str]) -> None:
    plain = {key: value for key, value in SCENARIO.items() if key != "timeline"}
    asked = tmp_path / "asked.yaml"
    asked.write_text(json.dumps({**plain, "security": {"keys": str(home.directory), "seal": True}}))
    assert harness("run", asked, "--backend", "sim", "--seed", "2", "--out", tmp_path / "run").returncode == 0
    came = brought_home(tmp_path / "run", tmp_path / "came")
    closed = harness("reconstruct", came, "--out", tmp_path / "closed.yaml")
    assert closed.returncode == 2
    assert "datagrams in captures of agents 1, 2 and 3 are not read without --bundle" in closed.stderr
    opened = harness("reconstruct", came, "--out", tmp_path / "opened.yaml", *keys)
    assert (opened.returncode, "reproduces all 3 chains" in opened.stdout) == (0, True), opened.stdout + opened.stderr
    left = [*left_in(tmp_path), ("its output", (opened.stdout + opened.stderr + closed.stderr).encode())]
    assert leaks(secrets(home, 12), left) == []
