"""Test the computed history of known runs: votes, reconciles, messages, and the number of copies of blocks over
time.
"""

from pathlib import Path
from typing import Any

import pytest

from harness.archive import archive
from harness.archive.archive import RunArchive
from harness.archive.history import (
    CUT_SHORT,
    AgentReconcile,
    AgentVote,
    BroadcastMessage,
    Phase2Tie,
    ReconcilePhase,
    end_of_traces,
    history_of,
)
from harness.archive.replication import ReplicationFigures, replication_of
from harness.archive.run_record import FaultRecord
from harness.archive.traces import Trace, TraceHeader
from harness.checker.uniform_chain import common_prefix
from harness.play.progress import SilentProgress
from harness.run.run import run
from harness.run.simulate import Simulated, simulate
from harness.scenario import load_scenario
from tests.harness.virtual import scenario
from ucp.trace import HandlerRun, SentMessage, StateSummary
from ucp.trigger import EventTrigger, MessageTrigger, OperatorTrigger

SCENARIOS = Path(__file__).parents[3] / "scenarios"
ROUGH: dict[str, Any] = {
    "agents": 5,
    "duration_s": 600,
    "network": {"loss": 0.2},
    "timeline": [
        {"at_s": 100, "partition": [[1, 2], [3, 4, 5]]},
        {"at_s": 200, "kill": [2]},
        {"at_s": 250, "heal": True},
        {"at_s": 300, "restart": [2]},
        {"at_s": 350, "reboot": [3], "down_s": 30, "disk": "kept"},
        {"at_s": 400, "reboot": [4], "down_s": 30, "disk": "lost"},
        {"at_s": 500, "kill": [5]},
    ],
    "settings": {"max_block_bytes": 600},
}


def simulated_run(name: str) -> Simulated:
    return simulate(load_scenario(SCENARIOS / f"{name}.yaml"), 1, tracing=True)


def faults(simulated: Simulated) -> list[FaultRecord]:
    assert simulated.evidence.record is not None
    return simulated.evidence.record.faults


def handler_run(at_s: float, handler: str, branch: str = "", **keys: Any) -> HandlerRun:
    state = StateSummary(0, 0, 0, reconciling=False, idle=True, top="")
    given = {"trigger": EventTrigger(1), "changes": [], "sent": [], **keys}
    return HandlerRun(at_s, handler, 1, branch=branch, state=state, **given)


def trace_of(agent: int, *incarnations: list[HandlerRun]) -> Trace:
    trace = Trace(TraceHeader(agent_id=agent, roster=[1, 2, 3], settings={}, clock={}))
    for number, life in enumerate(incarnations):
        trace.starts += [len(trace.runs)] if number else []
        trace.runs += life
    return trace


def test_tie_has_votes_and_phases_of_both_reconciles() -> None:
    simulated = simulated_run("forced_tie")
    traces, names = simulated.evidence.traces, simulated.evidence.names
    found = history_of(traces, faults(simulated), end_of_traces(traces))
    assert [(vote.agent, names[vote.block], vote.start_s, vote.end_s, vote.outcome) for vote in found.votes] == [
        (1, "1.1", 22.0, 32.0, "not approved"),
        (1, "1.1", 42.0, 52.0, "approved"),
        (2, "2.1", 3.0, 13.0, "approved"),
    ]
    phases = [ReconcilePhase("phase 1", 32.0, 37.0, 1), ReconcilePhase("phase 2", 37.0, 42.0, 1)]
    assert found.reconciles[0] == AgentReconcile(1, 32.0, 42.0, "vote not approved", phases, done=True)
    assert found.ties[0] == Phase2Tie(1, 42.0, "tie: top of chain")
    fetched = next(one for one in found.reconciles if one.agent == 2 and one.reason == "chain diverged")
    assert [(phase.name, phase.rounds) for phase in fetched.phases] == [
        ("phase 1", 2),
        ("phase 2", 1),
        ("phase 3", 1),
        ("phase 2", 1),
    ]
    assert len(found.reconciles) == simulated.result.figures["reconciles"]


def test_lost_commit_lacks_the_receipt_of_one_agent() -> None:
    simulated = simulated_run("lost_last_commit")
    traces, names = simulated.evidence.traces, simulated.evidence.names
    found = history_of(traces, [], end_of_traces(traces))
    assert found.messages is not None
    heard = {
        names[message.block or ""]: sorted(agent for agent, _ in message.receipts)
        for message in found.messages
        if message.name == "Commit Block"
    }
    assert heard == {"1.1": [2, 3, 4, 5], "2.1": [1, 3, 4, 5], "4.1": [1, 2, 3, 5], "4.2": [1, 3, 5]}
    how = {(commit.agent, names[commit.block]): commit.how for commit in found.commits}
    assert how[4, "4.2"] == "voted for"
    assert how[1, "4.2"] == "heard"
    assert (2, "4.2") not in how


def test_vote_ends_at_the_loss_or_at_the_end_of_the_run() -> None:
    proposed = handler_run(
        5.0, "process_next_deque_block", "proposed", sent=[SentMessage("Block Add Request", 0, "aa")]
    )
    begun = [
        handler_run(6.0, "reconcile_begin", "begun", trigger=OperatorTrigger("reconcile")),
        handler_run(6.0, "reconcile_phase_1"),
    ]
    traces = {1: trace_of(1, [proposed, *begun], [handler_run(30.0, "process_next_deque_block", "proposed")])}
    found = history_of(traces, [FaultRecord(at_s=8.0, what="kill", detail="", agents=[1])], 50.0)
    assert found.votes == [
        AgentVote(1, "aa", 5.0, 8.0, CUT_SHORT),
        AgentVote(1, "", 30.0, 50.0, CUT_SHORT),
    ]
    phases = [ReconcilePhase("phase 1", 6.0, 8.0, 1)]
    assert found.reconciles == [AgentReconcile(1, 6.0, 8.0, "asked by the operator", phases, done=False)]


def test_vote_of_killed_agent_ends_before_its_next_incarnation() -> None:
    proposed = [handler_run(at_s, "process_next_deque_block", "proposed") for at_s in (8.2, 30.0)]
    traces = {1: trace_of(1, [proposed[0]], [proposed[1]])}
    found = history_of(traces, [FaultRecord(at_s=8.0, what="kill", detail="", agents=[1])], 50.0)
    assert [(vote.start_s, vote.end_s) for vote in found.votes] == [(8.2, 30.0), (30.0, 50.0)]


def test_receipt_belongs_to_the_sending_incarnation() -> None:
    sends = [
        [handler_run(at_s, "build_data_block", sent=[SentMessage("Commit Block", 0, None)])] for at_s in (1.0, 20.0)
    ]
    hears = [
        handler_run(at_s, "receive_commit_block", trigger=MessageTrigger("Commit Block", 1, 0)) for at_s in (2.0, 21.0)
    ]
    found = history_of({1: trace_of(1, *sends), 2: trace_of(2, hears)}, [], 30.0)
    assert found.messages == [
        BroadcastMessage(1, 1.0, "Commit Block", None, [(2, 2.0)]),
        BroadcastMessage(1, 20.0, "Commit Block", None, [(2, 21.0)]),
    ]


@pytest.mark.parametrize("at_s", [float("nan"), float("inf"), -1.0, 1e300])
def test_handler_run_with_impossible_time_is_left_out(at_s: float) -> None:
    commit = handler_run(at_s, "receive_commit_block", changes=[("complete", "aa"), ("chain+", "aa")])
    traces = {1: trace_of(1, [handler_run(1.0, "build_data_block"), commit])}
    assert history_of(traces, [], end_of_traces(traces)).commits == []
    assert replication_of(traces, []) == [ReplicationFigures(0.0, 0, 0, 1, None, None)]
    assert end_of_traces(traces) == 1.0


@pytest.mark.parametrize("final_reconcile", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_replication_at_the_end_equals_the_checker_figures(seed: int, final_reconcile: bool) -> None:
    simulated = simulate(scenario(**ROUGH, final_reconcile=final_reconcile), seed, tracing=True)
    end, figures = replication_of(simulated.evidence.traces, faults(simulated))[-1], simulated.result.figures
    assert end.copies_mean is not None
    assert {
        "mutual_chain": end.mutual_chain,
        "longest_chain": end.longest_chain,
        "distinct_chains": end.distinct_chains,
        "copies_min": end.copies_min,
        "copies_mean": round(end.copies_mean, 3),
    }.items() <= figures.items()


def test_replication_equals_the_replayed_chains_at_every_moment() -> None:
    simulated = simulate(scenario(agents=5, duration_s=900, network={"loss": 0.3}), 3, tracing=True)
    traces = simulated.evidence.traces
    chains: dict[int, list[str]] = {agent: [] for agent in traces}
    completed: set[str] = set()
    found = {one.at_s: one for one in replication_of(traces, [])}
    now = found[0.0]
    runs = sorted(
        ((one.t, agent, one) for agent, trace in traces.items() for one in trace.runs), key=lambda step: step[0]
    )
    times = [at_s for at_s, _, _ in runs]
    for number, (at_s, agent, one) in enumerate(runs):
        for operation, block in one.changes:
            if operation == "complete":
                completed.add(block)
            elif operation == "chain+":
                chains[agent].append(block)
            elif operation == "chain-":
                assert chains[agent].pop() == block
        if number + 1 == len(runs) or times[number + 1] > at_s:
            now = found.get(at_s, now)
            copies = [sum(block in chain for chain in chains.values()) for block in completed]
            kept = [tuple(chain) for chain in chains.values()]
            assert now.mutual_chain == common_prefix(kept), at_s
            assert now.longest_chain == max(map(len, kept))
            assert now.distinct_chains == len(set(kept))
            assert now.copies_min == min(copies, default=None)
            assert now.copies_mean == (sum(copies) / len(copies) if copies else None)
    assert simulated.result.figures["reconciles"], "chains were also taken apart"


def changes(at_s: float, *operations: str) -> HandlerRun:
    """Return a handler run with these changes, which are texts such as "chain+ aa"."""
    return handler_run(at_s, "", changes=[(one.split()[0], one.split()[1]) for one in operations])


def test_mutual_chain_shrinks_when_an_agent_removes_blocks() -> None:
    both = [changes(1.0, "chain+ aa"), changes(2.0, "chain+ bb")]
    traces = {1: trace_of(1, both), 2: trace_of(2, [*both, changes(3.0, "chain- bb"), changes(4.0, "chain+ cc")])}
    assert [
        (one.at_s, one.mutual_chain, one.longest_chain, one.distinct_chains) for one in replication_of(traces, [])
    ] == [
        (0.0, 0, 0, 1),
        (1.0, 1, 1, 1),
        (2.0, 2, 2, 1),
        (3.0, 1, 2, 2),
    ], "at 4 s nothing that is counted changed"


@pytest.mark.parametrize(("disk", "copies"), [("lost", [2, 1, 1, 2]), ("kept", [2, 2, 2, 2])])
def test_block_on_a_lost_disk_is_no_copy(disk: Any, copies: list[int]) -> None:
    first, again = changes(1.0, "complete aa", "chain+ aa"), changes(9.0, "chain+ aa")
    traces = {1: trace_of(1, [first], [again]), 2: trace_of(2, [changes(1.0, "chain+ aa")])}
    downs = [
        FaultRecord(at_s=at_s, what=what, detail="", agents=[1], disk=disk)
        for at_s, what in ((5.0, "reboot"), (7.0, "boot"))
    ]
    found = replication_of(traces, downs)
    assert [[one for one in found if one.at_s <= at_s][-1].copies_min for at_s in (1.0, 5.0, 7.0, 9.0)] == copies


def test_skimmed_large_traces_give_the_same_history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = run(scenario(**ROUGH), 5, tmp_path / "run", SilentProgress(), backend="sim")
    all_of_it = RunArchive(ran.directory)
    whole = all_of_it.traces
    assert not all_of_it.large
    monkeypatch.setattr(archive, "LARGE_BYTES", 1000)
    skimmed = RunArchive(ran.directory, skim=True)
    part = skimmed.traces
    assert skimmed.large
    assert skimmed.problems == []
    assert part == {agent_id: trace.skimmed() for agent_id, trace in whole.items()}
    assert sum(len(trace.runs) for trace in part.values()) < sum(len(trace.runs) for trace in whole.values())
    one, other = history_of(whole, [], 900.0), history_of(part, [], 900.0, whole=False)
    assert (one.votes, one.commits, one.ties) == (other.votes, other.commits, other.ties)
    assert one.reconciles == other.reconciles
    assert one.messages
    assert other.messages is None
    assert replication_of(whole, []) == replication_of(part, [])


def test_invalid_or_foreign_trace_is_left_out_and_reported(tmp_path: Path) -> None:
    ran = run(scenario(agents=3, duration_s=60), 1, tmp_path / "run", SilentProgress(), backend="sim")
    agents = ran.directory / "agents"
    (agents / "8.trace.jsonl").write_text("[" * 100_000)
    (agents / "9.trace.jsonl").write_bytes((agents / "1.trace.jsonl").read_bytes())
    with (agents / "2.trace.jsonl").open("a") as file:
        file.write('{"t": "never"}\n')
    run_archive = RunArchive(ran.directory)
    assert sorted(run_archive.traces) == [1, 2, 3]
    named = [Path(problem.split(":")[0]).name for problem in run_archive.problems]
    assert named == ["2.trace.jsonl", "8.trace.jsonl", "9.trace.jsonl"]
    assert [len(problem.splitlines()) for problem in run_archive.problems] == [1, 1, 1]
