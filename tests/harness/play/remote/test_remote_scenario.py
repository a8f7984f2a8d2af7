"""Test which scenarios with remote agents the harness refuses, and how it takes the delay of a connection into
account.
"""

from pathlib import Path
from typing import Any

import pytest

from harness.archive.directory import RunDirectory
from harness.archive.run_journals import LagLine, MeasuredLag
from harness.errors import HarnessError, ScenarioError
from harness.play.backends import BACKENDS
from harness.play.remote._remote_agents import RemoteAgents
from harness.play.remote.join import join_commands
from harness.play.remote.secret_file import create_secret
from harness.scenario import Scenario
from harness.scenario.load import parse
from netem.conditions import Delay, LinkConditions, NetworkConditions
from tests.harness.command import harness, sentences, write_scenario

REMOTE = {"agents": [2], "secret_file": "lab.key", "listen": "192.168.7.1:14700"}


def scenario(**keys: Any) -> Scenario:
    usual = {"name": "Remote", "agents": 3, "vehicles": {"kind": "none"}, "remote": REMOTE}
    return parse({**usual, **keys})


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"remote": {**REMOTE, "agents": [4]}}, "not on the roster"),
        ({"remote": {**REMOTE, "agents": [2, 2]}}, "names an agent twice"),
        ({"remote": {**REMOTE, "listen": "14700"}}, "must be ADDRESS:PORT"),
        ({"agent_command": {2: ["true"]}}, "leave it out of `agent_command`"),
        ({"vehicles": {"kind": "embedded"}}, "source: random"),
    ],
)
def test_impossible_remote_agents_are_refused(keys: dict[str, Any], why: str) -> None:
    with pytest.raises(ScenarioError, match=why):
        scenario(**keys)


@pytest.mark.parametrize("backend", ["sim", "docker"])
def test_other_backends_refuse_remote_agents(backend: Any) -> None:
    with pytest.raises(ScenarioError, match="--backend process"):
        BACKENDS[backend].refuse(scenario())


def test_harness_prints_the_command_of_each_far_end() -> None:
    assert join_commands(scenario()) == ["ucp-harness join 192.168.7.1:14700 --as 2 --secret-file FILE -- COMMAND"]
    everywhere = scenario(remote={**REMOTE, "listen": "0.0.0.0:14700"})
    assert "join ADDRESS-OF-THIS-COMPUTER:14700 --as 2" in join_commands(everywhere)[0]


def test_harness_listens_nowhere_by_default(tmp_path: Path) -> None:
    create_secret(tmp_path / "lab.key")
    remote = {"agents": [2], "secret_file": str(tmp_path / "lab.key")}
    path = write_scenario(tmp_path, vehicles={"kind": "none"}, remote=remote)
    done = harness("run", path, "--out", tmp_path / "run")
    assert done.returncode == 2
    (sentence,) = sentences(done.stderr)
    assert sentence.endswith("no address is set for it: add `--listen ADDRESS:PORT`")


def test_address_of_another_machine_is_refused(tmp_path: Path) -> None:
    create_secret(tmp_path / "lab.key")
    path = write_scenario(
        tmp_path, vehicles={"kind": "none"}, remote={**REMOTE, "secret_file": str(tmp_path / "lab.key")}
    )
    done = harness("run", path, "--out", tmp_path / "run", "--listen", "203.0.113.7:14700")
    assert done.returncode == 3
    (sentence,) = sentences(done.stderr)
    assert sentence.startswith("the harness cannot listen at 203.0.113.7:14700 (Cannot assign requested address)")


def test_missing_secret_is_refused_before_the_run(tmp_path: Path) -> None:
    path = write_scenario(
        tmp_path, vehicles={"kind": "none"}, remote={**REMOTE, "secret_file": str(tmp_path / "lab.key")}
    )
    done = harness("run", path, "--out", tmp_path / "run")
    assert done.returncode == 2
    (sentence,) = sentences(done.stderr)
    assert "--new-secret" in sentence


# The delay of the connection


def agents(tmp_path: Path, delay_s: float) -> RemoteAgents:
    found = RemoteAgents(scenario(), RunDirectory(tmp_path / "run"), lambda: 0.0)
    found._vehicles[2].delay_s = delay_s
    return found


def test_delay_of_the_connection_is_part_of_the_requested_delay(tmp_path: Path) -> None:
    asked = NetworkConditions(LinkConditions(loss=0.1, delay=Delay(0.020, 0.005)))
    applied = agents(tmp_path, 0.003).compensated(asked)
    for pair in ((1, 2), (2, 1), (2, 3), (3, 2)):
        assert applied.link(*pair) == LinkConditions(loss=0.1, delay=Delay(0.017, 0.005))
    assert applied.link(1, 3) == asked.link(1, 3)


def test_scenario_without_delay_keeps_its_conditions(tmp_path: Path) -> None:
    asked = NetworkConditions(LinkConditions(loss=0.1), {3: LinkConditions(delay=Delay(0.0))})
    applied = agents(tmp_path, 0.003).compensated(asked)
    assert all(applied.link(*pair) == asked.link(*pair) for pair in ((1, 2), (2, 1), (2, 3), (1, 3)))


def test_shorter_delay_than_that_of_the_connection_is_refused(tmp_path: Path) -> None:
    asked = NetworkConditions(LinkConditions(delay=Delay(0.006, 0.004)))
    with pytest.raises(HarnessError, match=r"from 1 to 2 must have a delay of 2 ms .* alone takes 3 ms"):
        agents(tmp_path, 0.003).compensated(asked)


def test_lag_of_a_remote_agent_is_that_of_its_computer() -> None:
    def line(from_s: float, machine_s: float, busy: dict[str, float], computer: str | None = None) -> LagLine:
        return LagLine(from_s=from_s, until_s=from_s + 2, machine_s=machine_s, busy_s=busy, computer_of=computer)

    lag = MeasuredLag([line(at, 0.5, {"1": 0.0}) for at in range(0, 10, 2)] + [line(1, 0.01, {"2": 0.02}, "2")])
    assert lag.explains(1, 1.5, 2.5) == 1.0
    assert lag.explains(2, 1.5, 2.5) == pytest.approx(0.03)
    assert lag.explains(2, 1.5, 3.5) is None, "the far computer was measured up to 3 s"


def test_lag_of_a_worker_counts_for_all_its_agents() -> None:
    here = LagLine(from_s=0, until_s=9, machine_s=0.5, busy_s={})
    there = LagLine(from_s=0, until_s=9, machine_s=0.01, busy_s={"1": 0.0, "2": 0.02}, computer_of="1")
    lag = MeasuredLag([here, there])
    assert [lag.explains(agent, 1, 2) for agent in (1, 2, 3)] == [0.01, pytest.approx(0.03), None]
