"""Test encrypted event data: agents exchange them, the checker judges their blocks, and only the depot can read
them.
"""

import base64
import dataclasses
import json
import re
from pathlib import Path

import pytest

from harness.archive.exports import SUFFIX, Export
from harness.archive.traces import HANDLER_RUN, Trace, TraceHeader
from harness.checker import Evidence, steps
from harness.play.keyring.key_directory import KeyDirectory
from tests.harness.command import harness
from tests.ucp.air import Air
from ucp.agent import Agent
from ucp.export import export_chain
from ucp.sealed import seal_to
from ucp.secure.sealing import make_seal
from ucp.settings import Settings
from ucp.trace import SCHEMA, RecordedBytes, in_base64

ROSTER = (1, 2, 3)
SETTINGS = Settings(max_block_bytes=976)
LOGGED = b"nobody else reads this"


class SealedSwarm:
    """Three agents that have committed a few encrypted blocks. Their exports and keys are in a directory."""

    def __init__(self, directory: Path) -> None:
        self.home = KeyDirectory.new(directory / "keys", ROSTER, seals=True, epoch_s=600.0)
        bundles = self.home.bundles()
        self.initial_data = seal_to(b"sealed", bundles[1].public.depot or b"")
        self.air = Air(ROSTER)
        self.air.agents = {
            agent_id: Agent(agent_id, ROSTER, self.initial_data, SETTINGS, seal=make_seal(bundle))
            for agent_id, bundle in bundles.items()
        }
        for agent_id in ROSTER:
            for number in range(40):
                self.air.log(agent_id, LOGGED + bytes([number]))
            self.air.settle()
        self.exports = {agent_id: export_chain(agent.state, 1) for agent_id, agent in self.air.agents.items()}
        self.directory = directory / "home"
        self.directory.mkdir()
        for agent_id, export in self.exports.items():
            (self.directory / f"{agent_id}{SUFFIX}").write_text(json.dumps(export))

    def evidence(self) -> Evidence:
        clock = {"epoch_us": 0, "speedup": 1.0}
        traces = {
            agent_id: Trace(
                TraceHeader(
                    schema=SCHEMA,
                    agent_id=agent_id,
                    roster=list(ROSTER),
                    settings=SETTINGS.to_json(),
                    clock=clock,
                    initial_data=in_base64(self.initial_data),
                ),
                [HANDLER_RUN.validate_json(run.to_line()) for run in runs],
            )
            for agent_id, runs in self.air.runs.items()
        }
        return Evidence({agent: Export.model_validate(export) for agent, export in self.exports.items()}, traces)


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> SealedSwarm:
    return SealedSwarm(tmp_path_factory.mktemp("sealed"))


def test_other_agents_store_sealed_events_and_cannot_read_them(swarm: SealedSwarm) -> None:
    chains = [[block["block_hash"] for block in export["chain"]] for export in swarm.exports.values()]
    assert chains[0] == chains[1] == chains[2] and len(chains[0]) >= 3
    for export in swarm.exports.values():
        for block in export["chain"]:
            assert LOGGED not in base64.b64decode(block["event_data"])


def test_trace_shows_the_events_of_its_own_vehicle_only(swarm: SealedSwarm) -> None:
    logged = {agent_id: f"logged by {agent_id}".encode() for agent_id in ROSTER}
    air = Air(ROSTER)
    bundles = swarm.home.bundles()
    air.agents = {
        agent_id: Agent(agent_id, ROSTER, swarm.initial_data, SETTINGS, seal=make_seal(bundle))
        for agent_id, bundle in bundles.items()
    }
    for agent_id in ROSTER:
        for _ in range(60):
            air.log(agent_id, logged[agent_id])
        air.settle()
    for agent_id, runs in air.runs.items():
        texts = re.findall('"([A-Za-z0-9+/]{8,}=*)"', "".join(run.to_line() for run in runs))
        content = b"".join(base64.b64decode(text) for text in texts if len(text) % 4 == 0)
        assert {other for other in ROSTER if logged[other] in content} == {agent_id}


def test_checker_accepts_agents_that_seal_events(swarm: SealedSwarm) -> None:
    judgement = steps.check(swarm.evidence())
    assert judgement.verdict == "as specified", judgement


@pytest.mark.parametrize("sealed", [None, b"", LOGGED * 40, b"?"])
def test_judge_finds_an_agent_whose_trace_has_other_sealed_data(swarm: SealedSwarm, sealed: bytes | None) -> None:
    evidence = swarm.evidence()
    runs = evidence.traces[2].runs
    position = next(position for position, run in enumerate(runs) if run.sealed is not None)
    runs[position] = dataclasses.replace(
        runs[position], sealed=None if sealed is None else RecordedBytes(in_base64(sealed))
    )
    judgement = steps.check(evidence)
    assert judgement.verdict == "deviates"
    assert judgement.evidence[0].handler == "build_data_block"


def test_chains_report_encrypted_events_and_the_depot_key_decrypts_them(swarm: SealedSwarm) -> None:
    closed = harness("chain", "--decode", swarm.directory)
    assert closed.returncode == 0
    assert "sealed to the depot" in closed.stdout
    assert "event 7" not in closed.stdout
    key = swarm.home.directory / "depot.key"
    opened = harness("chain", "--decode", "--json", "--depot-key", key, swarm.directory)
    blocks = json.loads(opened.stdout)["agents"]["1"]["chain"]
    assert all(event["data"].startswith(LOGGED.hex()) for block in blocks for event in block["events"])
    closed = harness("chain", "--json", swarm.directory)
    assert all(
        block["sealed"] and block["events"] is None for block in json.loads(closed.stdout)["agents"]["1"]["chain"]
    )


def test_merged_record_has_events_after_the_depot_decrypts_them(swarm: SealedSwarm, tmp_path: Path) -> None:
    closed = harness("consolidate", swarm.directory, "--out", tmp_path / "closed.jsonl")
    assert closed.returncode == 0
    assert "sealed to the depot" in closed.stdout
    key = swarm.home.directory / "depot.key"
    opened = harness("consolidate", swarm.directory, "--out", tmp_path / "open.jsonl", "--depot-key", key)
    assert opened.returncode == 0, opened.stderr
    assert "sealed" not in opened.stdout
    events = {name: (tmp_path / name).read_text().count('"line":"event"') for name in ("closed.jsonl", "open.jsonl")}
    logged = sum(len(runs) for runs in ([r for r in rs if r.trigger.kind == "event"] for rs in swarm.air.runs.values()))
    assert events["open.jsonl"] == logged
    assert events["closed.jsonl"] < logged


def test_another_depots_key_is_refused(swarm: SealedSwarm, tmp_path: Path) -> None:
    other = KeyDirectory.new(tmp_path / "other", ROSTER, seals=True, epoch_s=600.0)
    for command in ("chain", "consolidate"):
        done = harness(command, swarm.directory, "--depot-key", other.directory)
        assert done.returncode == 2
        assert "sealed to another depot" in done.stderr


def test_block_with_a_wrong_header_is_not_decrypted(swarm: SealedSwarm, tmp_path: Path) -> None:
    export = json.loads(json.dumps(swarm.exports[1]))
    export["chain"][0]["event_data"] = base64.b64encode(b"in plain, by who has no depot key").decode()
    (tmp_path / f"1{SUFFIX}").write_text(json.dumps(export))
    done = harness("chain", "--depot-key", swarm.home.directory, tmp_path)
    assert "not sealed to this depot" in done.stdout
