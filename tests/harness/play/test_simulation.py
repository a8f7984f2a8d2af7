"""Test that a simulation always gives the same result, and that traces and omitted deliveries do not change a run."""

import hashlib
import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.exports import read_export
from harness.errors import MachineError, ScenarioError
from harness.play.progress import SilentProgress
from harness.play.simulation import _event_loop
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import load_scenario
from tests.harness.command import Running, sentences, write_scenario
from tests.harness.virtual import scenario
from tests.machine import require, unavailable
from ucp.agent import HANDLERS
from ucp.block import HASH_BYTES
from ucp.messages import BlockAddRequest, datagram_bytes
from ucp.trace import HandlerRun

SCENARIOS = Path(__file__).parents[3] / "scenarios"

WITHOUT_EFFECT = {
    "reconcile in progress",
    "no vote running",
    "another block",
    "another round",
    "counted already",
    "does not succeed",
    "held already",
    "not in phase 1",
    "not in phase 2",
    "not in phase 3",
    "another chain",
    "not held",
}
"""Branches in which a received message does not change the agent."""


def results_of(simulated: Simulated) -> dict[str, Any]:
    """Return the results of a run without its traces, and without the numbers of handler runs, which depend on
    traces.
    """
    exports = {agent_id: export.model_dump() for agent_id, export in simulated.evidence.exports.items()}
    agents = {
        agent_id: agent.model_copy(update={"handler_runs": []}) for agent_id, agent in simulated.played.agents.items()
    }
    played = replace(simulated.played, agents=agents)
    return {"exports": exports, "figures": simulated.result.figures, "played": played}


def effective_runs(simulated: Simulated) -> dict[int, list[str]]:
    return {
        agent_id: [
            run.to_line() for run in trace.runs if run.trigger.kind != "message" or run.branch not in WITHOUT_EFFECT
        ]
        for agent_id, trace in simulated.evidence.traces.items()
    }


probabilities = st.sampled_from([0.0, 0.1, 0.3, 0.7])
networks = st.fixed_dictionaries(
    {"loss": st.one_of(probabilities, st.just({"p": 0.05, "r": 0.2}))},
    optional={
        "duplicate": probabilities,
        "delay": st.sampled_from(
            [0.01, 3.0, {"mean_s": 0.5, "jitter_s": 0.4}, {"mean_s": 1, "jitter_s": 1, "distribution": "pareto"}]
        ),
        "rate": st.sampled_from([2400, 64_000]),
        "links": st.sampled_from(
            [
                [{"from": 1, "to": 2, "loss": 0.9}],
                [{"from": [1, 2], "to": 3, "delay": 2.0, "limit": 3, "corrupt": 0.1}],
            ]
        ),
    },
)
timelines = st.lists(
    st.sampled_from(
        [
            {"at_s": 50, "partition": [[1, 2], [3]]},
            {"at_s": 110, "heal": True},
            {"at_s": 150, "loss": 0.5},
            {"at_s": 195, "pause": [2]},
            {"at_s": 225, "kill": [1]},
            {"at_s": 225.01, "restart": [1]},
            {"at_s": 250, "resume": [2]},
            {"at_s": 158, "reboot": [3], "down_s": 10, "disk": "kept"},
        ]
    ),
    unique_by=lambda entry: float(entry["at_s"]),  # type: ignore[arg-type]
)


def playable(timeline: list[dict[str, Any]]) -> bool:
    return ("pause" in str(timeline)) >= ("resume" in str(timeline)) and ("kill" in str(timeline)) >= (
        "restart" in str(timeline)
    )


@settings(max_examples=15, phases=(Phase.explicit, Phase.generate))  # shrinking takes minutes
@given(
    network=networks,
    timeline=timelines.filter(playable),
    schedule=st.sampled_from(
        [
            [],
            [{"ramp": {"delay": [8.0, 0.0]}, "from_s": 75, "until_s": 150, "every_s": 37.5}],
            [{"nemesis": "bridge", "every_s": 60, "for_s": 30}, {"ramp": {"loss": [0, 0.6], "delay": [0.0, 4.0]}}],
        ]
    ),
    agents=st.integers(3, 7),
    mean_s=st.sampled_from([1, 3, 10]),
    clocks=st.sampled_from([{}, {2: {"offset_s": -3.5, "drift": 0.001}, 3: {"offset_s": 10}}]),
    final_reconcile=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_omitted_deliveries_change_no_agent(
    network: dict[str, Any],
    timeline: list[dict[str, Any]],
    schedule: list[dict[str, Any]],
    agents: int,
    mean_s: int,
    clocks: dict[int, Any],
    final_reconcile: bool,
    seed: int,
) -> None:
    """Compare with a simulation that delivers every message: exports, figures and effective handler runs must be
    equal.
    """
    one = scenario(
        agents=agents,
        duration_s=300,
        network=network,
        timeline=timeline,
        schedule=schedule,
        events={"source": "random", "mean_s": mean_s},
        clocks=clocks,
        settle={"limit_s": 300},
        final_reconcile=final_reconcile,
    )
    fast, all_ = simulate(one, seed, tracing=True), simulate(one, seed, tracing=True, deliver_all=True)
    assert results_of(fast) == results_of(all_)
    assert effective_runs(fast) == effective_runs(all_)
    assert results_of(simulate(one, seed)) == results_of(fast)


@pytest.mark.parametrize("quirk", ["vote_while_reconciling", "count_phase1_of_others"])
def test_wrong_agents_receive_all_messages(quirk: str) -> None:
    """One wrong agent sends answers during a reconcile. The other wrong agent counts answers to queries of other
    agents.
    """
    right = scenario(network={"loss": 0.2})
    wrong = scenario(network={"loss": 0.2}, quirks={quirk: True})
    default = results_of(simulate(wrong, 1))
    assert default == results_of(simulate(wrong, 1, deliver_all=True))
    assert default != results_of(simulate(right, 1))
    off = scenario(network={"loss": 0.2}, quirks={quirk: False})
    assert digest(simulate(off, 1, tracing=True)) == digest(simulate(right, 1, tracing=True))


def test_quirk_affects_only_the_named_agents() -> None:
    """All agents without the deliberate error are correct. A deliberate error with the value false has no effect."""
    some = scenario(network={"loss": 0.2}, quirks={"vote_while_reconciling": {"agents": [2, 3]}})
    assert some.quirks_of(2) == {"vote_while_reconciling": True} and some.quirks_of(1) == {}
    steps = simulate(some, 1, tracing=True).result.beside["steps"]
    assert steps.verdict == "deviates" and {finding.agent_id for finding in steps.evidence} <= {2, 3}
    all_named = scenario(network={"loss": 0.2}, quirks={"vote_while_reconciling": {"agents": [1, 2, 3, 4, 5]}})
    alike = scenario(network={"loss": 0.2}, quirks={"vote_while_reconciling": True})
    assert digest(simulate(all_named, 1, tracing=True)) == digest(simulate(alike, 1, tracing=True))
    switched_off = scenario(network={"loss": 0.2}, quirks={"vote_while_reconciling": {"agents": [2], "value": False}})
    right = scenario(network={"loss": 0.2})
    assert digest(simulate(switched_off, 1, tracing=True)) == digest(simulate(right, 1, tracing=True))


def test_agent_that_changes_a_received_message_damages_no_other_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    """All receivers share one object for each message, unless an agent may be wrong."""
    right = HANDLERS["receive_request_add_block"]

    def run(core: Any, sender: int, message: BlockAddRequest) -> str:
        message.block_hash = bytes(HASH_BYTES)
        return right.run(core, sender, message)

    monkeypatch.setattr(_event_loop, "wrong_handlers", lambda quirks, rng: [replace(right, run=run)])
    one = scenario(quirks={"vote_while_reconciling": {"agents": [2]}})
    steps = simulate(one, 1, tracing=True).result.beside["steps"]
    assert steps.verdict == "deviates"
    assert {finding.agent_id for finding in steps.evidence} == {2}


def test_omitted_deliveries_change_no_agent_during_flight() -> None:
    one = load_scenario(SCENARIOS / "split_rejoin.yaml")
    fast, all_ = simulate(one, 1, tracing=True), simulate(one, 1, tracing=True, deliver_all=True)
    assert results_of(fast) == results_of(all_)
    assert effective_runs(fast) == effective_runs(all_)


def version_1(run: HandlerRun) -> str:
    line = json.loads(run.to_line())
    for key in ("input", "tally", "started"):
        line.pop(key, None)
    for sent in line["sent"]:
        del sent["datagram"]
    return json.dumps(line, separators=(",", ":")) + "\n"


def digest(simulated: Simulated) -> str:
    """Return a digest of exports, figures and traces. Traces are reduced to the keys of version 1 of the format."""
    document = results_of(simulated)
    del document["played"]
    traces = [version_1(run) for _, trace in sorted(simulated.evidence.traces.items()) for run in trace.runs]
    return hashlib.sha256(json.dumps([document, traces], sort_keys=True).encode()).hexdigest()[:16]


BURSTS = {
    "loss": {"p": 0.02, "r": 0.3},
    "delay": {"mean_s": 0.2, "jitter_s": 0.1, "distribution": "paretonormal"},
    "duplicate": 0.1,
    "reorder": 0.1,
}


@pytest.mark.parametrize(
    ("name", "seed", "expected"),
    [
        ("perfect.yaml", 1, "e5b6c24af37b9538"),
        ("loss_15.yaml", 1, "f1e908c522dc6fd8"),
        ("loss_15.yaml", 2, "a8cce796a772945e"),
        ("missed_commit.yaml", 1, "10472e41ff7f2740"),
        ("partition_heal.yaml", 1, "988c978a053cea73"),
        ("split_rejoin.yaml", 1, "314fd04da1a47bb4"),
        ("attrition.yaml", 1, "2dcf131485a492fe"),
        ("bursts", 1, "c096a7b164a7bf65"),
    ],
)
def test_seed_gives_the_same_run_on_every_machine(name: str, seed: int, expected: str) -> None:
    """A changed digest means that old seeds no longer give the same runs. The commit must explain it."""
    one = scenario(network=BURSTS, duration_s=600) if name == "bursts" else load_scenario(SCENARIOS / name)
    assert digest(simulate(one, seed, tracing=True)) == expected


def test_message_on_a_link_with_a_rate_takes_the_time_of_its_frame() -> None:
    traces = simulate(scenario(network={"rate": 9600}, duration_s=300), 1, tracing=True).evidence.traces
    sent_at = {(agent, sent.seq): run.t for agent, trace in traces.items() for run in trace.runs for sent in run.sent}
    triggers = [(run.t, run.trigger.to_json()) for trace in traces.values() for run in trace.runs]
    requests = [(at, it) for at, it in triggers if it.get("message") == BlockAddRequest.NAME]
    frame_bytes = datagram_bytes(BlockAddRequest(bytes(32), bytes(32))) + 42
    assert len(requests) > 4
    for at, trigger in requests:
        sent_by, sequence = trigger["from"], trigger["seq"]
        assert at - sent_at[int(sent_by), int(sequence)] == pytest.approx(frame_bytes * 8 / 9600, abs=1e-9)


def test_uniform_time_is_none_if_chains_differ() -> None:
    assert simulate(scenario(network={"loss": 1.0}), 1).result.figures["uniform_at_s"] is None
    assert simulate(scenario(), 1).result.figures["uniform_at_s"]


def test_other_seed_gives_another_run() -> None:
    one = scenario(duration_s=300)
    assert digest(simulate(one, 1)) == digest(simulate(one, 1)) != digest(simulate(one, 2))


def test_added_loss_does_not_change_the_events() -> None:
    """Events and losses use separate random number streams."""

    def completed(**network: Any) -> list[list[str]]:
        exports = simulate(scenario(network=network), 5).evidence.exports.values()
        return [export.completed for export in exports]

    assert completed() == completed(loss=0.3) == completed(loss=0.3, duplicate=0.2)


def test_random_event_that_is_too_large_is_not_logged() -> None:
    """Agents that run as processes do not log such an event either. The data of a random event has 32 to 256 bytes."""
    sizes = {"max_block_bytes": 150, "max_event_bytes": 100}
    small = scenario(duration_s=200, settings=sizes, events={"source": "random", "mean_s": 20})
    done = simulate(small, 1, tracing=True)
    assert done.result.figures["blocks"]
    assert not done.result.bad


def test_run_directory_equals_the_simulation_in_memory(tmp_path: Path) -> None:
    one = load_scenario(SCENARIOS / "loss_15.yaml")
    finished = run(one, 3, tmp_path / "run", SilentProgress(), "sim")
    in_memory = simulate(one, 3, tracing=True)
    assert finished.exit_status == 0
    assert finished.result.to_json() == in_memory.result.to_json()
    for agent_id, export in in_memory.evidence.exports.items():
        assert read_export(tmp_path / "run" / "agents" / f"{agent_id}.chain.json") == export
    again = checker.check(checker.gather(RunArchive(tmp_path / "run")))
    assert again.to_json() == finished.result.to_json()
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["backend"], record["outcome"], record["settled"]) == ("sim", "completed", True)
    network = [json.loads(line) for line in (tmp_path / "run" / "network.jsonl").read_text().splitlines()]
    assert [change["what"] for change in network] == ["start", "final reconcile"]


@pytest.mark.parametrize("name", ["attrition.yaml", "rogue.yaml"])
def test_judged_traces_equal_the_trace_files(name: str, tmp_path: Path) -> None:
    judged = run(load_scenario(SCENARIOS / name), 1, tmp_path / "run", SilentProgress(), "sim").played.traces
    assert judged is not None
    files = RunArchive(tmp_path / "run").traces
    assert [*files] == [*judged]
    for agent_id, trace in files.items():
        assert trace.header.model_dump() == judged[agent_id].header.model_dump()
        assert replace(trace, header=judged[agent_id].header) == judged[agent_id]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"vehicles": {"kind": "ardupilot"}}, "`vehicles.kind: ardupilot` needs real processes"),
        ({"vehicles": {"binary": "/bin/x"}}, "`vehicles.binary` needs real processes"),
        ({"agent_command": ["./nowhere"]}, "`agent_command`: ./nowhere is not a program"),
        (
            {"agent_command": {2: ["cat"]}, "lateness": {2: "3+0.25"}},
            "the harness controls the timers of its own agents",
        ),
    ],
)
def test_keys_that_need_processes_are_refused_in_virtual_time(keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ScenarioError, match=sentence):
        simulate(scenario(**keys), 1)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"fates": [{"sender": 1, "drop": True}]}, "`fates` needs"),
        (
            {
                "clocks": {1: {"drift": 0.1}},
                "events": {"source": "scripted", "script": [{"at_s": 1, "agent": 1, "timestamp_us": 7}]},
            },
            "`clocks`, `events.script.timestamp_us` need",
        ),
    ],
)
def test_keys_that_need_virtual_time_are_refused_for_processes(
    tmp_path: Path, keys: dict[str, Any], named: str
) -> None:
    with pytest.raises(ScenarioError, match=f"{named} virtual time: use --backend sim"):
        run(scenario(**keys), 1, tmp_path / "run", SilentProgress(), "process")
    assert not (tmp_path / "run").exists()


@pytest.mark.lab
def test_conditions_without_an_engine_are_refused_with_a_solution(tmp_path: Path) -> None:
    require(None)
    if unavailable("netem") is None:
        pytest.skip("this kernel has netem")
    network = {"delay": 1, "receivers": {2: {"rate": 9600}}}
    with pytest.raises(MachineError, match=r"Nothing does delay, receivers 2 rate here .*--backend sim") as caught:
        run(scenario(network=network), 1, tmp_path / "run", SilentProgress(), "process")
    assert caught.value.exit_status == 3
    assert not (tmp_path / "run").exists()


def test_conditions_impossible_at_the_speedup_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"`network` at `speedup` 0\.5: delay\.mean_s: 100\.0 is out of range"):
        run(scenario(network={"delay": 50}, speedup=0.5), 1, tmp_path / "run", SilentProgress(), "process")


def test_ctrl_c_ends_a_simulation_and_keeps_its_results(tmp_path: Path) -> None:
    keys = {"agents": 40, "network": {"loss": 0.3}, "events": {"source": "random"}}
    running = Running(write_scenario(tmp_path, duration_s=50_000, **keys), tmp_path / "run", "--backend", "sim")
    running.wait_for_mission(1)
    running.process.send_signal(signal.SIGINT)
    status, _, err = running.end()
    assert status == 130
    assert "interrupted at mission second" in " ".join(sentences(err))
    record = running.record()
    assert (record["outcome"], set(record["characteristics"])) == ("interrupted", set("123456"))
    assert len(list((tmp_path / "run" / "agents").glob("*.chain.json"))) == 40
