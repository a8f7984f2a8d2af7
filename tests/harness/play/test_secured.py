"""A secured mission in virtual time is the plain one, and nobody without keys gets in."""

from pathlib import Path

from harness.archive.packets.capture_files import read_captures
from harness.play.progress import Silent
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.agent_options import Security
from tests.harness.virtual import scenario

SCENARIOS = Path(__file__).parents[3] / "scenarios"


def dropped(run: Simulated) -> set[str]:
    """Why agents dropped what they did."""
    return {reason for agent in run.played.agents.values() for reason in agent.get("dropped", {})}


def secured(plain: Scenario) -> Scenario:
    return plain.model_copy(update={"security": Security()})


def test_a_sweep_that_delivers_what_matters_is_the_run_that_delivers_all() -> None:
    request = secured(scenario(network={"loss": 0.2}, timeline=[{"at_s": 300, "partition": [[1, 2]]}], duration_s=600))
    sweep, whole = simulate(request, 3), simulate(request, 3, deliver_all=True)
    assert sweep.result.chains == whole.result.chains
    assert sweep.played.agents == whole.played.agents


def test_a_secured_mission_is_judged_as_a_plain_one() -> None:
    judged = simulate(secured(scenario(network={"loss": 0.1}, duration_s=300)), 2, tracing=True)
    assert judged.result.characteristics["1"].kind == "good"
    assert not judged.result.bad
    assert not dropped(judged)


def test_what_comes_twice_is_a_replay_and_on_record() -> None:
    judged = simulate(secured(scenario(network={"duplicate": 0.5}, duration_s=300)), 2, tracing=True)
    assert not judged.result.bad
    assert dropped(judged) == {"replayed"}


def test_who_has_no_keys_forges_nothing() -> None:
    rogue = load_scenario(SCENARIOS / "rogue.yaml")
    assert simulate(rogue, 1, tracing=True).result.bad
    judged = simulate(secured(rogue), 1, tracing=True)
    assert not judged.result.bad


def test_a_capture_shows_who_said_what_kind_of_thing_and_agrees_with_the_traces(tmp_path: Path) -> None:
    request = secured(scenario(duration_s=200, capture=True, events={"mean_s": 5}))
    finished = run(request, 1, tmp_path / "run", Silent(), "sim")
    assert not finished.result.bad
    seen = list(read_captures(sorted((tmp_path / "run" / "capture").iterdir())).datagrams)
    assert {datagram.summary.message for datagram in seen} >= {"Block Add Request", "Commit Block"}
    assert all(datagram.summary.is_sealed for datagram in seen)
