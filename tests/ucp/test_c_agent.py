"""Test the agent in C (`ucp/contract/examples/ucp_agent.c`): the requirements for any agent, and errors that are
typical of C.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

import ucp
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance.vectors import VectorSet, to_lines
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import simulate
from tests.harness.command import harness, write_scenario
from tests.harness.virtual import scenario
from tests.machine import do_without
from tests.ucp import refusals
from ucp.contract.vectors import INDEX
from ucp.contract.vectors.replay import Player, play

SOURCE = Path(ucp.__path__[0]) / "contract" / "examples" / "ucp_agent.c"
VECTORS = INDEX.parent.parent
ABOUT: dict[str, dict[str, Any]] = json.loads(INDEX.read_text(encoding="ascii"))
TRANSCRIPTS = {*ABOUT}
SECURED = {name for name, about in ABOUT.items() if "secured" in about["features"]}
FEATURES = (
    "store",
    "vote_names_chain",
    "changed_before_tally",
    "asks_after_commit",
    "top_needs_majority",
    "phase1_tie=pop",
    "phase2_tie=block",
    "answer_spread_s",
)
WARNINGS = ["-std=c11", "-Wall", "-Wextra", "-Werror"]
HARD_RUN: dict[str, Any] = {
    "network": {"loss": 0.15},
    "timeline": [{"at_s": 50, "partition": [[1, 2], [3]]}, {"at_s": 100, "heal": True}],
    "events": {"source": "random", "mean_s": 10},
    "final_reconcile": True,
}


def compiled(program: Path, *options: str, libraries: Sequence[str] = ()) -> Path:
    if shutil.which("cc") is None:
        do_without("cc", "no C compiler (Debian packages `gcc` and `libc6-dev`)")
    subprocess.run(["cc", *WARNINGS, *options, "-o", program, SOURCE, "-lm", *libraries], check=True)
    return program


@pytest.fixture(scope="session")
def agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("c agent") / "ucp_agent", "-O2")


@pytest.fixture(scope="session")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the agent in C with sanitizers. It ends at the first undefined behaviour or memory leak."""
    folder = tmp_path_factory.mktemp("checked")
    probe = ["cc", "-fsanitize=address,undefined", "-x", "c", "-o", folder / "probe", "-"]
    if shutil.which("cc") and subprocess.run(probe, input=b"int main(void){return 0;}", check=False).returncode != 0:
        do_without("cc", "no sanitizers (Debian package `libgcc-12-dev`)")
    options = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover")
    return compiled(folder / "ucp_agent", *options)


@pytest.fixture(scope="session")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the secured agent in C with sanitizers. It ends at the first undefined behaviour or memory leak."""
    folder = tmp_path_factory.mktemp("secured")
    probe = ["cc", "-fsanitize=address,undefined", "-x", "c", "-o", folder / "probe", "-", "-lcrypto"]
    code = b"#include <openssl/evp.h>\nint main(void){return EVP_chacha20_poly1305() == 0;}"
    if shutil.which("cc") and subprocess.run(probe, input=code, capture_output=True, check=False).returncode != 0:
        do_without("cc", "no OpenSSL 3 to compile with (Debian package `libssl-dev`), or no sanitizers")
    options = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover", "-DSECURED")
    return compiled(folder / "ucp_agent", *options, libraries=("-lcrypto",))


@pytest.fixture(scope="module")
def player(agent: Path) -> Iterator[Player]:
    with Player([str(agent)]) as playing:
        yield playing


def mission(**keys: Any) -> dict[str, Any]:
    network = {"address": "127.0.0.1", "broadcast": "127.255.255.255", "port": 14600}
    return {
        "schema": "ucp-mission/1",
        "agent_id": 7,
        "roster": [1, 7, 28],
        "initial_data": "dGVzdA==",
        "network": network,
        "events": {"source": "none"},
        "seed": 1,
        "speedup": 1,
        "epoch_us": 0,
        **keys,
    }


def vectors(name: str) -> Any:
    return json.loads((VECTORS / f"{name}.json").read_text(encoding="ascii"))


@pytest.mark.parametrize("name", sorted(TRANSCRIPTS - SECURED))
def test_c_agent_plays_each_transcript(name: str, player: Player) -> None:
    assert play(player, INDEX.with_name(f"{name}.jsonl")) is None


@pytest.mark.parametrize("name", sorted(SECURED))
def test_c_agent_plays_the_secured_transcript(name: str, player: Player, secured: Path) -> None:
    lacks = play(player, INDEX.with_name(f"{name}.jsonl"))
    assert lacks is not None and lacks.startswith("not supported")
    with Player([str(secured)]) as playing:
        assert play(playing, INDEX.with_name(f"{name}.jsonl")) is None


def test_agent_plays_or_refuses_ambiguous_missions_as_specified(agent: Path, secured: Path, tmp_path: Path) -> None:
    for command, features in ((agent, FEATURES), (secured, (*FEATURES, "secured", "sealed"))):
        assert not refusals.wrong_missions([str(command)], features)
        assert not refusals.wrong_exits([str(command)], features, tmp_path)


def test_agent_answers_ambiguous_requests_as_in_the_vectors(checked: Path, tmp_path: Path) -> None:
    assert not refusals.wrong_answers([str(checked)], tmp_path)


def test_c_agent_passes_generated_vectors(agent: Path) -> None:
    """Each generated path is a list of states with their inputs. It leads from the mission to the end."""
    steps = list(explore(VARIANTS["default"]))[::8]
    lines = to_lines([VectorSet(VARIANTS["default"], steps, {step.key: step for step in steps})])
    by_number = {step["step"]: step for step in map(json.loads, lines) if "step" in step}
    ends = by_number.keys() - {step["after"] for step in by_number.values()}
    played = []
    for end in sorted(ends):
        way = [by_number[end]]
        while way[-1]["after"] is not None:
            way.append(by_number[way[-1]["after"]])
        played += reversed(way)
    inputs = "".join(json.dumps(step["in"]) + "\n" for step in played)
    done = subprocess.run([agent, "--virtual"], input=inputs, capture_output=True, text=True, check=True)
    answers = [json.loads(answer) for answer in done.stdout.splitlines()]
    assert len(ends) > 500
    for step, answer in zip(played, answers, strict=True):
        if step["after"] is not None:
            assert {key: answer[key] for key in step["out"]} == step["out"], step


def test_c_agent_drops_datagrams_with_the_reasons_of_the_vectors(player: Player) -> None:
    drops = vectors("drops")
    player.give({"t": 0, "mission": mission(agent_id=drops["agent_id"], roster=drops["roster"])})
    for number, drop in enumerate(drops["datagrams"]):
        (line,) = player.give({"t": number, "datagram": drop["datagram"]})["trace"][:1]
        assert line.get("dropped") == drop["dropped"], drop["what"]


def test_c_agent_builds_the_blocks_of_the_vectors(player: Player) -> None:
    for case in vectors("blocks"):
        settings = {key: case[key] for key in ("max_block_bytes", "max_event_bytes")}
        player.give(
            {"t": 0, "mission": mission(agent_id=case["agent_id"], roster=[case["agent_id"]], settings=settings)}
        )
        for event in case["events"]:
            keys = ("event_id", "data", "timestamp_us")
            line = player.give({"t": 0, **{key: event[key] for key in keys}})["trace"][0]
            assert line["branch"] == event["branch"]
            if "block" in event:
                assert line["changes"][0] == ["complete", event["block"]["block_hash"]]


def test_c_agent_computes_inception_blocks(player: Player) -> None:
    for block in vectors("hashes")["inception"]:
        player.give({"t": 0, "mission": mission(initial_data=block["initial_data"])})
        assert player.give({"t": 0, "command": "status"})["answer"]["top_chain_hash"] == block["chain_hash"]


@pytest.mark.parametrize(
    ("changed", "status", "word"),
    [
        ({"features": ["phase1_tie=coin"], "settings": {"phase1_tie": "coin"}}, 127, "phase1_tie=coin"),
        ({"features": ["quirks"]}, 127, "quirks"),
        ({"quirks": {"ignore_commit": 0.5}}, 127, "quirks"),
        ({"events": {"source": "mavlink"}}, 127, "telemetry"),
        ({"schema": "ucp-mission/2", "features": ["quirks"]}, 2, "ucp-mission/1"),
        ({"settings": {"max_block_bytes": 100}}, 2, "max_event_bytes"),
        ({"seed": 2**64}, 2, "seed"),
        ({"roster": [1, 28]}, 2, "roster"),
    ],
)
def test_c_agent_refuses_a_mission_in_one_sentence(
    agent: Path, tmp_path: Path, changed: dict[str, Any], status: int, word: str
) -> None:
    (tmp_path / "7.mission.json").write_text(json.dumps(mission(**changed)))
    done = subprocess.run([agent, "7.mission.json"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (status, 1)
    assert word in done.stderr


def test_hostile_lines_do_not_harm_the_c_agent(checked: Path) -> None:
    """The agent answers damaged input lines without leaking memory."""
    random = Random(1)
    lines = []
    for transcript in sorted(INDEX.parent.glob("*.jsonl")):
        for line in transcript.read_text(encoding="ascii").splitlines():
            given = bytearray(json.dumps(json.loads(line)["input"]).encode())
            lines.append(bytes(given))
            for _ in range(random.randrange(4)):
                at = random.randrange(len(given))
                given[at : at + random.randrange(3)] = random.choice([b"", b'"', b"9", b"\\u0", b"\xff", b"[[[", b"{"])
            lines.append(bytes(given))
    lines += [b"", b"[" * 100_000, b'{"t": 1e999, "timer": true}', b'{"t": 1e300, "timer": true}']
    sent = b"".join(line + b"\n" for line in lines)
    done = subprocess.run([checked, "--virtual"], input=sent, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    answers = [json.loads(answer) for answer in done.stdout.splitlines()]
    assert len(answers) == len(lines)
    assert 0 < sum("error" in answer for answer in answers) < len(lines)


def test_c_agents_and_our_agent_agree_in_virtual_time(agent: Path, tmp_path: Path) -> None:
    reboot = {"at_s": 130, "reboot": [3], "down_s": 5, "disk": "kept"}
    keys = {**HARD_RUN, "timeline": [*HARD_RUN["timeline"], reboot], "duration_s": 200}
    mixed = scenario(agents=3, agent_command={1: [str(agent)], 3: [str(agent)]}, **keys)
    finished = run(mixed, 1, tmp_path / "run", SilentProgress(), "sim")
    assert finished.exit_status == 0
    assert_nothing_to_find(tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text(encoding="utf-8"))
    assert record["agents"]["1"]["version"] == "ucp_agent.c, 1"


def test_c_agent_without_keys_reports_the_missing_feature(agent: Path) -> None:
    with Player([str(agent)]) as player:
        for keys in ({"features": ["secured"], "security": {"bundle": "7.json"}}, {"security": {"bundle": "7.json"}}):
            answer = player.give({"t": 0, "mission": mission(**keys)})
            assert answer["unsupported"] and "secured" in answer["error"]


def test_secured_c_agent_drops_the_datagrams_of_the_vectors(secured: Path) -> None:
    vectors = json.loads((VECTORS / "secured.json").read_text(encoding="ascii"))
    drops = vectors["drops"]
    mission_document = mission(roster=drops["roster"], features=["secured"], security={"bundle": "7.bundle.json"})
    with Player([str(secured)]) as player:
        begun = player.give(
            {"t": drops["now"], "mission": mission_document, "boot": vectors["boot"], "bundle": {"schema": "x"}}
        )
        assert "bundle" in begun["error"]
        begun = {"t": 0.0, "mission": mission_document, "boot": vectors["boot"], "bundle": vectors["bundles"]["7"]}
        assert "error" not in player.give(begun)
        player.give({"t": 0.0, "datagram": ""})
        for case in drops["datagrams"]:
            (line,) = player.give({"t": drops["now"], "datagram": case["datagram"]})["trace"]
            assert line.get("dropped") == case["dropped"], case["what"]


SECURED_RUN: dict[str, Any] = {
    **HARD_RUN,
    "duration_s": 250,
    "timeline": [
        *HARD_RUN["timeline"],
        {"at_s": 130, "reboot": [3], "down_s": 5, "disk": "kept"},
        {"at_s": 160, "forge": {"message": "Commit Block", "sender": 4}},
        {"at_s": 170, "kill": [4]},
        {"at_s": 180, "revoke": [4], "heard_by": [1]},
        {"at_s": 200, "replay": {"count": 100}},
    ],
}


def test_secured_c_agent_sends_the_same_bytes_as_our_agent(secured: Path) -> None:
    """The mission is encrypted, and contains a reboot, an excluded vehicle and repeated datagrams."""
    ours = scenario(agents=4, security={"seal": True}, **SECURED_RUN)
    mixed = ours.model_copy(update={"agent_command": {1: [str(secured)], 3: [str(secured)]}})
    played, among_ours = simulate(mixed, 1, tracing=True), simulate(ours, 1, tracing=True, deliver_all=True)
    exports = [run.evidence.exports for run in (played, among_ours)]
    assert {agent: export.model_dump() for agent, export in exports[0].items()} == {
        agent: export.model_dump() for agent, export in exports[1].items()
    }
    assert {agent: player.dropped for agent, player in played.played.agents.items()} == {
        agent: player.dropped for agent, player in among_ours.played.agents.items()
    }
    assert not played.result.bad


@pytest.mark.lab
@pytest.mark.any_user
def test_secured_c_agents_and_our_agent_agree_over_udp(secured: Path, tmp_path: Path) -> None:
    commands = {1: [str(secured)], 3: [str(secured)]}
    keys = {"agents": 4, "agent_command": commands, "security": {"seal": True, "captured": 4}}
    path = write_scenario(tmp_path, vehicles={"kind": "none"}, speedup=20, **keys, **SECURED_RUN)
    environment = {**os.environ, "ASAN_OPTIONS": "exitcode=99"}
    done = harness("run", path, "--seed", 1, "--out", tmp_path / "run", env=environment)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text(encoding="utf-8"))
    assert (record["steps"]["verdict"], record["records"]["verdict"]) == ("as specified", "agree"), record
    assert "revoked sender" in {reason for agent in record["agents"].values() for reason in agent["dropped"]}


@pytest.mark.lab
@pytest.mark.any_user
def test_c_agents_and_our_agent_agree_over_udp(checked: Path, agent: Path, tmp_path: Path) -> None:
    commands = {1: [str(agent)], 3: [str(checked)]}
    path = write_scenario(tmp_path, vehicles={"kind": "none"}, duration_s=150, agent_command=commands, **HARD_RUN)
    environment = {**os.environ, "ASAN_OPTIONS": "exitcode=99"}
    done = harness("run", path, "--seed", 1, "--out", tmp_path / "run", env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert_nothing_to_find(tmp_path / "run")


def assert_nothing_to_find(directory: Path) -> None:
    record = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    assert {verdict["verdict"] for verdict in record["characteristics"].values()} == {"holds"}
    assert record["steps"]["verdict"] == "as specified"
    assert record["records"]["verdict"] == "agree"
    assert record["figures"]["blocks"] > 0
