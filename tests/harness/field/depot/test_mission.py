"""Test `ucp-harness mission`, which writes mission files and compares the files of all vehicles."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness.archive.exports import Export
from harness.errors import RunDirectoryError
from harness.field.depot.mission_comparison import MissionComparison, compare
from harness.field.depot.mission_files import Manifest, MissionFileError, MissionPlan, write
from tests.harness.command import harness, sentences
from tests.harness.mission import edit
from tests.harness.virtual import scenario
from ucp.agent import Agent
from ucp.block import InceptionBlock
from ucp.export import export_chain
from ucp.mission import load_mission
from ucp.sealed import sealed_to
from ucp.secure.bundle import load_bundle
from ucp.trace import header_line

ROSTER = [10, 28, 32, 118, 120, 122]
DATA = b"the second field test"


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    write(MissionPlan(scenario(agents=ROSTER, name="field"), DATA), tmp_path / "mission")
    return tmp_path / "mission"


def sentences_of(comparison: MissionComparison) -> list[str]:
    return [str(difference) for difference in comparison.differences]


# New


def test_each_vehicle_gets_a_valid_mission_file(directory: Path) -> None:
    missions = {agent_id: load_mission(directory / f"{agent_id}.mission.json") for agent_id in ROSTER}
    assert {mission.initial_data for mission in missions.values()} == {DATA}
    assert {mission.roster for mission in missions.values()} == {tuple(ROSTER)}
    assert len({mission.seed for mission in missions.values()}) == len(ROSTER)
    assert [mission.network.address for mission in missions.values()] == [f"10.77.0.{agent}" for agent in ROSTER]
    assert {mission.speedup for mission in missions.values()} == {1.0}
    assert {mission.store for mission in missions.values()} == {f"{agent_id}.store" for agent_id in ROSTER}
    assert {path.name for path in directory.iterdir()} == {
        "manifest.json",
        *(f"{agent_id}.mission.json" for agent_id in ROSTER),
    }


def test_manifest_has_the_hashes_of_the_inception_block(directory: Path) -> None:
    manifest = Manifest.model_validate_json((directory / "manifest.json").read_text())
    inception = InceptionBlock(DATA)
    assert manifest.inception.block_hash == inception.block_hash.hex()
    assert manifest.inception.chain_hash == inception.chain_hash.hex()
    assert manifest.roster == ROSTER


def test_each_file_has_the_requested_options(tmp_path: Path) -> None:
    done = harness(
        *("mission", "new", "--agents", "7,9", "--name", "two", "--out", tmp_path / "m", "--initial-data", "BD 0"),
        *("--setting", "vote_timeout_s=8", "--setting", "phase1_tie=pop", "--event", "log=mode,position"),
        *("--event", "source=none", "--subnet", "192.168.4.0/24", "--address", "9=192.168.4.200", "--port", "15000"),
    )
    assert (done.returncode, done.stderr) == (0, "")
    nine = load_mission(tmp_path / "m" / "9.mission.json")
    assert nine.initial_data == b"BD 0"
    assert (nine.settings.vote_timeout_s, nine.settings.phase1_tie) == (8, "pop")
    assert (nine.events.source, nine.events.log) == ("none", ("mode", "position"))
    assert (nine.network.address, nine.network.broadcast, nine.network.port) == (
        "192.168.4.200",
        "192.168.4.255",
        15000,
    )
    assert load_mission(tmp_path / "m" / "7.mission.json").network.address == "192.168.4.7"
    assert harness("mission", "verify", tmp_path / "m").returncode == 0


def test_scenario_gives_roster_and_settings_without_quirks(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    asked = {"name": "s", "agents": [3, 4], "settings": {"vote_timeout_s": 7}, "quirks": {"ignore_commit": 0.5}}
    asked["initial_data"] = "QkQgMA=="
    path.write_text(json.dumps(asked))
    done = harness("mission", "new", "--scenario", path, "--out", tmp_path / "m")
    assert done.returncode == 0
    (sentence,) = sentences(done.stderr)
    assert "ignore_commit" in sentence
    four = load_mission(tmp_path / "m" / "4.mission.json")
    assert (four.settings.vote_timeout_s, four.initial_data) == (7, b"BD 0")
    assert harness("mission", "verify", tmp_path / "m").returncode == 0


def test_missions_of_the_same_name_have_different_inception_blocks(tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert harness("mission", "new", "--agents", "2", "--name", "same", "--out", tmp_path / name).returncode == 0
    done = harness("mission", "verify", tmp_path / "a", tmp_path / "b")
    assert done.returncode == 1
    assert "inception block" in done.stdout


def test_existing_files_are_kept_without_the_overwrite_option(directory: Path) -> None:
    before = (directory / "10.mission.json").read_text()
    plan = MissionPlan(scenario(agents=ROSTER), b"another")
    with pytest.raises(RunDirectoryError, match="--overwrite"):
        write(plan, directory)
    assert (directory / "10.mission.json").read_text() == before
    write(plan, directory, overwrite=True)
    assert load_mission(directory / "10.mission.json").initial_data == b"another"


def test_stale_mission_file_in_the_directory_is_an_error(directory: Path) -> None:
    with pytest.raises(RunDirectoryError, match=r"122\.mission\.json"):
        write(MissionPlan(scenario(agents=ROSTER[:-1]), DATA), directory, overwrite=True)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ((), "--agents"),
        (("--agents", "1,x"), "`--agents`"),
        (("--agents", "1,1"), "twice"),
        (("--agents", "0"), "1..1000"),
        (("--agents", "2", "--setting", "vote=1"), "`settings.vote` is unknown"),
        (("--agents", "2", "--setting", "vote_timeout_s"), "KEY=VALUE"),
        (("--agents", "2", "--setting", "vote_timeout_s=-1"), "vote_timeout_s must be more than 0"),
        (("--agents", "2", "--event", "source=dice"), "random, mavlink or none"),
        (("--agents", "2", "--event", "log=everything"), "`events.log`"),
        (("--agents", "2", "--subnet", "10.0.0.0/31"), "no address"),
        (("--agents", "300", "--subnet", "10.0.0.0/24"), "no address"),
        (("--agents", "2", "--subnet", "here"), "`--subnet`"),
        (("--agents", "2", "--address", "1=10.77.0.2"), "have the same address 10.77.0.2: choose another `--address`"),
        (("--agents", "2", "--address", "7=10.77.0.2"), "vehicle 7, which is not on the roster"),
        (("--agents", "2", "--address", "1=here"), "`network.address` must be an IPv4 address"),
        (("--agents", "2", "--broadcast", "all"), "`network.broadcast` must be an IPv4 address"),
        (("--agents", "2", "--initial-data", "@/does/not/exist"), "cannot be read"),
        (("--scenario", "/does/not/exist"), "/does/not/exist"),
    ],
)
def test_invalid_mission_gives_one_sentence(tmp_path: Path, options: tuple[str, ...], sentence: str) -> None:
    done = harness("mission", "new", *options, "--out", tmp_path / "m")
    assert done.returncode == 2
    (message,) = sentences(done.stderr)
    assert sentence in message
    assert not (tmp_path / "m").exists()


def test_too_long_initial_data_is_rejected() -> None:
    with pytest.raises(MissionFileError, match="initial data"):
        MissionPlan(scenario(), bytes(600_000)).documents()


# Verify


def test_files_of_one_mission_compare_as_equal(directory: Path) -> None:
    comparison = compare([directory])
    assert (comparison.verdict, sentences_of(comparison)) == ("same", [])
    assert "6 mission files" in comparison.in_words()


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        (lambda d: d.update(initial_data="AAAA"), "initial_data", "inception block"),
        (lambda d: d.update(roster=ROSTER[1:]), "roster", "118, 120, 122"),
        (lambda d: d["settings"].update(vote_timeout_s=9), "settings.vote_timeout_s", "is 9, and 10.0 in"),
        (lambda d: d["settings"].update(phase1_tie="pop"), "settings.phase1_tie", '"pop"'),
        (lambda d: d["network"].update(port=14601), "network.port", "14601, and 14600"),
        (lambda d: d["network"].update(broadcast="10.0.0.255"), "network.broadcast", "10.0.0.255"),
        (lambda d: d["network"].update(address="10.77.0.10"), "network.address", "as in"),
        (lambda d: d.update(seed=d["seed"] - 1), None, ""),
        (lambda d: d.update(speedup=2), "speedup", "is 2.0, and 1.0 in"),
        (lambda d: d.update(epoch_us=5), "epoch_us", "is 5, and null in"),
        (lambda d: d["quirks"].update(ignore_commit=0.1), "quirks.ignore_commit", "mistake"),
        (lambda d: d["quirks"].update(ignore_commit=0), None, ""),
        (lambda d: d.update(signature="of a later version"), None, ""),
        (lambda d: d["roster"].reverse(), None, ""),
        (lambda d: d["settings"].update(vote_timeout_s=10), None, ""),
    ],
)
def test_each_difference_names_file_and_key(
    directory: Path, change: Callable[[dict[str, Any]], Any], key: str | None, words: str
) -> None:
    for manifest in (True, False):
        path = directory / "122.mission.json"
        if manifest:
            edit(path, change)
        else:
            (directory / "manifest.json").unlink()
        comparison = compare([directory])
        if key is None:
            assert sentences_of(comparison) == []
            continue
        about = [difference for difference in comparison.differences if difference.key == key]
        assert [difference.file for difference in about] == [path]
        assert words in str(about[0])
        assert f"`{key}`" in str(about[0])
        assert str(path) in str(about[0])


def test_shared_seed_is_reported(directory: Path) -> None:
    seed = load_mission(directory / "10.mission.json").seed
    path = directory / "28.mission.json"
    edit(path, lambda document: document.update(seed=seed))
    (difference,) = compare([directory]).differences
    assert (difference.file, difference.key) == (path, "seed")


def test_vehicle_without_mission_file_is_reported(directory: Path) -> None:
    (directory / "32.mission.json").unlink()
    (difference,) = compare([directory]).differences
    assert "agent 32" in str(difference)


def test_two_files_of_one_agent_differ_but_one_given_twice_does_not(directory: Path, tmp_path: Path) -> None:
    again = directory / "10.mission.json"
    assert compare([directory, again]).verdict == "same"
    (tmp_path / "copy.json").write_text(again.read_text())
    comparison = compare([directory, tmp_path / "copy.json"])
    assert {difference.key for difference in comparison.differences} == {"agent_id", "network.address", "seed"}


def test_files_may_be_in_one_directory_per_vehicle(directory: Path, tmp_path: Path) -> None:
    for path in directory.glob("*.mission.json"):
        (tmp_path / "vehicles" / path.name).mkdir(parents=True)
        path.rename(tmp_path / "vehicles" / path.name / "mission.json")
    assert compare([tmp_path / "vehicles"]).verdict == "same"


def test_exports_and_traces_must_have_the_same_inception_block(directory: Path, tmp_path: Path) -> None:
    for data in (DATA, b"another mission"):
        agent = Agent(28, ROSTER, data)
        (tmp_path / "28.chain.json").write_text(json.dumps(export_chain(agent.state, 0)))
        clock = {"epoch_us": 0, "speedup": 1}
        line = header_line(agent_id=28, roster=ROSTER, initial_data=data, settings={}, clock=clock)
        (tmp_path / "28.trace.jsonl").write_text(line)
        comparison = compare([directory, tmp_path / "28.chain.json", tmp_path / "28.trace.jsonl"])
        keys = [(difference.file, difference.key) for difference in comparison.differences]
        assert keys == (
            []
            if data == DATA
            else [
                (tmp_path / "28.chain.json", "inception.block_data"),
                (tmp_path / "28.trace.jsonl", "initial_data"),
            ]
        )


def test_empty_trace_in_a_directory_is_ignored(directory: Path) -> None:
    trace = directory / "28.trace.jsonl"
    trace.touch()
    assert compare([directory]).verdict == "same"
    (difference,) = compare([directory, trace]).differences
    assert "empty" in str(difference)


def test_export_of_an_unknown_agent_is_reported(directory: Path, tmp_path: Path) -> None:
    path = tmp_path / "5.chain.json"
    path.write_text(json.dumps(export_chain(Agent(5, [5], DATA).state, 0)))
    Export.model_validate_json(path.read_text())
    (difference,) = compare([directory, path]).differences
    assert (difference.file, difference.key) == (path, "agent_id")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b'{"schema": "ucp-mission/9"}',
        b'{"schema": "ucp-mission/1", "agent_id": ' + b"9" * 5000 + b"}",
        b'{"schema": "ucp-mission-manifest/1"}',
        b'{"schema": "ucp-chain-export/1"}',
        b'{"schema": "ucp-trace/2"}',
        b'{"schema": ["ucp-mission/1"]}',
        b"[" * 100_000,
        b'{"schema": "ucp-trace/1", "agent_id": 1, "roster": [1], "settings": {}, "clock": {}}',
    ],
)
def test_unreadable_file_is_a_difference(directory: Path, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.mission.json"
    path.write_bytes(content)
    (difference,) = compare([directory, path]).differences
    assert difference.file == path
    assert compare([path]).verdict == "nothing usable"


def test_exit_status_shows_the_result_of_the_comparison(directory: Path, tmp_path: Path) -> None:
    assert harness("mission", "verify", directory).returncode == 0
    edit(directory / "120.mission.json", lambda document: document["network"].update(port=1))
    done = harness("mission", "verify", directory, "--json")
    assert done.returncode == 1
    document = json.loads(done.stdout)
    assert (document["verdict"], [gap["key"] for gap in document["differences"]]) == ("differ", ["network.port"])
    (tmp_path / "x.json").write_text("{}")
    done = harness("mission", "verify", tmp_path / "x.json")
    assert done.returncode == 2
    assert len(sentences(done.stderr)) == 1
    assert harness("mission", "verify", tmp_path / "nowhere").returncode == 2


def test_secured_mission_has_a_key_bundle_per_vehicle(tmp_path: Path) -> None:
    home, out = tmp_path / "keys", tmp_path / "mission"
    assert harness("keys", "new", home, "--agents", "1,7").returncode == 0
    done = harness("mission", "new", "--agents", "1,7", "--keys", home, "--out", out)
    assert done.returncode == 0, done.stderr
    mission = load_mission(out / "7.mission.json")
    assert mission.security is not None
    assert load_bundle(out / mission.security.bundle).public.depot == sealed_to(mission.initial_data)
    assert mission.settings.max_block_bytes == 976
    assert harness("mission", "verify", out).returncode == 0
    done = harness("mission", "new", "--agents", "1,8", "--keys", home, "--out", tmp_path / "other")
    assert (done.returncode, "agent 8 is not in this mission" in done.stderr) == (2, True)
    assert not (tmp_path / "other").exists()
