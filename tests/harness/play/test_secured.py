"""Test that a secured mission in virtual time drops forged messages, and has the same verdicts as a plain mission."""

from pathlib import Path

from harness.archive.packets.capture_files import read_captures
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.agent_options import SecurityOptions
from tests.harness.virtual import scenario

SCENARIOS = Path(__file__).parents[3] / "scenarios"


def dropped(run: Simulated) -> set[str]:
    """Return the reasons for which agents dropped datagrams."""
    return {reason for agent in run.played.agents.values() for reason in agent.dropped or ()}


def secured(plain: Scenario) -> Scenario:
    return plain.model_copy(update={"security": SecurityOptions()})


def test_omitted_deliveries_change_no_secured_agent() -> None:
    request = secured(scenario(network={"loss": 0.2}, timeline=[{"at_s": 300, "partition": [[1, 2]]}], duration_s=600))
    sweep, whole = simulate(request, 3), simulate(request, 3, deliver_all=True)
    assert sweep.result.chains == whole.result.chains
    assert sweep.played.agents == whole.played.agents


def test_secured_mission_is_judged_like_a_plain_one() -> None:
    judged = simulate(secured(scenario(network={"loss": 0.1}, duration_s=300)), 2, tracing=True)
    assert judged.result.characteristics["1"].kind == "good"
    assert not judged.result.bad
    assert not dropped(judged)


def test_duplicate_datagram_is_recorded_as_a_replay() -> None:
    judged = simulate(secured(scenario(network={"duplicate": 0.5}, duration_s=300)), 2, tracing=True)
    assert not judged.result.bad
    assert dropped(judged) == {"replayed"}


def test_rogue_node_without_keys_has_no_effect() -> None:
    rogue = load_scenario(SCENARIOS / "rogue.yaml")
    assert simulate(rogue, 1, tracing=True).result.bad
    judged = simulate(secured(rogue), 1, tracing=True)
    assert not judged.result.bad


def test_capture_shows_senders_and_types_of_sealed_messages(tmp_path: Path) -> None:
    request = secured(scenario(duration_s=200, capture=True, events={"mean_s": 5}))
    finished = run(request, 1, tmp_path / "run", SilentProgress(), "sim")
    assert not finished.result.bad
    seen = list(read_captures(sorted((tmp_path / "run" / "capture").iterdir())).datagrams)
    assert {datagram.summary.message for datagram in seen} >= {"Block Add Request", "Commit Block"}
    assert all(datagram.summary.is_sealed for datagram in seen)


def test_jammed_radio_separates_vehicles_only_while_it_lasts() -> None:
    jam = [{"at_s": 100, "partition": [[1], [2], [3]]}, {"at_s": 300, "heal": True}]
    events = {"mean_s": 5}
    until = secured(scenario(agents=3, duration_s=300, timeline=jam[:1], events=events))
    jammed = simulate(until, 1, tracing=True)
    assert not jammed.result.bad
    assert len({chain[-1] for chain in jammed.result.chains.values()}) == 3
    after = secured(scenario(agents=3, duration_s=600, timeline=jam, events=events, final_reconcile=True))
    united = simulate(after, 1, tracing=True)
    assert not united.result.bad
    assert united.result.characteristics["6"].verdict == "holds"
