"""Test that no file of a run and no error message contains a secret, whether the run succeeds or fails."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from harness.play.keyring.key_directory import KeyDirectory
from tests.harness.command import harness
from tests.harness.secure.secrets import boots_in, forms, leaks, left_in, secrets

ROSTER = [1, 2, 3]
EPOCHS = 14
"""Number of epochs whose secrets the test searches for. An epoch is a period with its own group secret. Later epochs
are included, because a vehicle may follow other vehicles to them.
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> KeyDirectory:
    """Create the keys and bundles of a mission with short epochs."""
    home = KeyDirectory.new(tmp_path_factory.mktemp("secrets") / "keys", ROSTER, seals=True, epoch_s=30.0)
    home.write_bundles(home.directory.parent / "bundles")
    return home


def scenario(directory: Path, home: KeyDirectory, **keys: Any) -> Path:
    path = directory / "secret.yaml"
    security = {"keys": str(home.directory.parent / "bundles"), "seal": True, "captured": 3}
    asked = {
        "name": "secret",
        "agents": ROSTER,
        "duration_s": 120,
        "events": {"source": "random", "mean_s": 5},
        "security": security,
        "capture": True,
        "timeline": [{"at_s": 60, "forge": {"message": "Commit Block", "sender": 3}}],
    }
    path.write_text(json.dumps({**asked, **keys}))
    return path


def run(asked: Path, *options: str) -> tuple[int, list[tuple[str, bytes]]]:
    """Run the scenario. Return its exit status, and the content of its output and files."""
    out = asked.parent / "run"
    done = harness("run", asked, "--seed", "1", "--out", out, *options)
    left = list(left_in(out)) if out.exists() else []
    return done.returncode, [("its output", (done.stdout + done.stderr).encode()), *left]


def test_files_of_a_run_contain_no_secret(home: KeyDirectory, tmp_path: Path) -> None:
    status, left = run(scenario(tmp_path, home), "--backend", "sim")
    assert status in (0, 1), left[0]
    names = {Path(name).name for name, _ in left}
    assert {"run.json", "report.html", "rogue.jsonl", "1.trace.jsonl", "1.chain.json", "1.pcapng"} <= names
    boots = {life for name, content in left if name.endswith(".pcapng") for life in boots_in(content)}
    assert {sender for sender, _ in boots} == {*ROSTER}
    known = secrets(home, EPOCHS, boots)
    assert len(known) > len(ROSTER) * EPOCHS
    assert leaks(known, left) == []


@pytest.mark.lab
@pytest.mark.any_user
def test_files_of_a_failed_run_of_processes_contain_no_secret(
    home: KeyDirectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program of agent 2 prints all its input and ends."""
    monkeypatch.setenv("TOKEN_OF_THE_USER", "a token")
    tells = ["sh", "-c", "cat *.mission.json; printenv; exit 3"]
    asked = scenario(tmp_path, home, agent_command={"2": tells}, capture=False, speedup=20, duration_s=40, timeline=[])
    status, left = run(asked, "--backend", "process")
    assert status == 1, left[0]
    assert any(b"bundle" in content and b"PATH=" in content for name, content in left if name.endswith("2.log"))
    assert not any(b"a token" in content for _, content in left)
    assert leaks(secrets(home, EPOCHS), left) == []


@pytest.mark.lab
@pytest.mark.any_user
def test_agent_as_a_process_reads_keys_of_other_agents(home: KeyDirectory, tmp_path: Path) -> None:
    """This test shows a known limit, which the threat model states. Containers would separate the agents."""
    reads = """cat "$(sed -n 's/.*"bundle": *"\\([^"]*\\)".*/\\1/p' 1.mission.json)" > 2.read; exit 3"""
    asked = scenario(tmp_path, home, agent_command={"2": ["sh", "-c", reads]}, capture=False, speedup=20, timeline=[])
    status, left = run(asked, "--backend", "process")
    assert status == 1, left[0]
    others = {"private key of 1": secrets(home, 1)["private key of 1"]}
    assert leaks(others, left) == [f"private key of 1 in {tmp_path / 'run/agents/2.read'}"]


@pytest.mark.parametrize("tells", ["error", "version"])
def test_virtual_agent_that_repeats_its_input_reveals_no_secret(home: KeyDirectory, tmp_path: Path, tells: str) -> None:
    """The agent refuses its mission with a copy of its input, or puts its input into its status."""
    says = {
        "error": "{'error': 'no: ' + str(given.get('bundle'))[-190:]}",
        "version": "{'sent': [], 'timer': None, 'trace': [], 'answer': str(given)}",
    }[tells]
    agent = tmp_path / "agent.py"
    agent.write_text(
        f"import json, sys\nfor line in sys.stdin:\n given = json.loads(line)\n print(json.dumps({says}), flush=True)\n"
    )
    asked = scenario(tmp_path, home, agent_command={"2": [sys.executable, str(agent)]}, capture=False, timeline=[])
    status, left = run(asked, "--backend", "sim")
    assert status == 1, left[0]
    if tells == "error":
        assert b"(a secret)" in left[0][1]
    shown = {name: secret[:8] for name, secret in secrets(home, EPOCHS).items()}
    assert leaks(shown, left) == []


@pytest.mark.lab
@pytest.mark.any_user
def test_captured_keys_forge_only_blocks_of_their_vehicle(home: KeyDirectory, tmp_path: Path) -> None:
    """Play the run with processes. The test also checks that the run directory contains no secret."""
    forged = [{"at_s": 60, "forge": {"message": "Commit Block", "sender": sender}} for sender in (3,)]
    forged += [{"at_s": 80, "forge": {"message": "Commit Block", "sender": 2}}]
    asked = scenario(tmp_path, home, speedup=20, timeline=forged, capture=False)
    status, left = run(asked, "--backend", "process")
    assert status == 1, left[0]
    record = json.loads(dict(left)[str(tmp_path / "run/run.json")])
    genuine = record["characteristics"]["4"]
    assert genuine["verdict"] == "violated"
    assert all(
        "agent 3 never completed, although the block is signed with its key" in finding["detail"]
        for finding in genuine["evidence"]
    )
    dropped = [reason for agent in record["agents"].values() for reason in agent["dropped"]]
    assert "not signed by its sender" in dropped
    assert leaks(secrets(home, EPOCHS), left) == []


@pytest.mark.parametrize("mistake", ["mode", "swapped", "cut off", "text"])
def test_no_error_message_has_a_secret(home: KeyDirectory, tmp_path: Path, mistake: str) -> None:
    bundles = tmp_path / "bundles"
    home.write_bundles(bundles)
    path = bundles / "2.bundle.json"
    document = json.loads(path.read_text())
    match mistake:
        case "mode":
            path.chmod(0o644)
        case "swapped":
            other = json.loads((bundles / "3.bundle.json").read_text())["private_key"]
            path.write_text(json.dumps({**document, "private_key": other}))
        case "cut off":
            path.write_text(path.read_text()[:-20])
        case "text":
            path.write_text(json.dumps({**document, "group_secret": [document["group_secret"]], "epoch": "x"}))
    asked = scenario(tmp_path, home)
    asked.write_text(asked.read_text().replace(str(home.directory.parent / "bundles"), str(bundles)))
    done = harness("keys", "inspect", bundles)
    status, left = run(asked, "--backend", "sim")
    assert (status, done.returncode) == (2, 2)
    assert "2.bundle.json" in done.stderr
    assert leaks(secrets(home, EPOCHS), [*left, ("inspect", (done.stdout + done.stderr).encode())]) == []


def test_each_form_of_a_secret_would_be_found() -> None:
    secret = os.urandom(32)
    for number, form in enumerate(forms(secret)):
        assert leaks({"it": secret}, [("a file", b"before " + form + b" behind")]), number
    inside = json.dumps({"data": [1, *secret, 2]}).encode()
    assert leaks({"it": secret}, [("a file", inside)])
