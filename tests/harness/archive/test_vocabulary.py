"""Test undefined names in traces: they cause no violation, but a wrong Algorithm number does."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from harness.archive.archive import RunArchive
from harness.archive.traces import Trace
from harness.archive.vocabulary import MESSAGES, OPERATIONS, TIMERS, VOTES
from harness.checker import Evidence, check
from harness.checker.survival import in_words, survival
from harness.field.replay import RecordPlayer, open_record
from harness.play.progress import SilentProgress
from harness.report import write_report
from harness.run.run import run
from harness.run.simulate import simulate
from tests.harness.command import harness
from tests.harness.virtual import scenario
from ucp.agent import HANDLERS
from ucp.trace import HandlerRun
from ucp.trigger import KINDS, LocalTrigger, MessageTrigger, TimerTrigger, parse

EVENTFUL = {
    "agents": 4,
    "network": {"loss": 0.3},
    "duration_s": 500,
    "timeline": [
        {"at_s": 130, "kill": [2]},
        {"at_s": 150, "restart": [2]},
        {"at_s": 300, "reboot": [3], "down_s": 20, "disk": "kept"},
    ],
    "final_reconcile": True,
}

Rename = Callable[[HandlerRun], HandlerRun]


@pytest.fixture(scope="module")
def honest() -> Evidence:
    """Return the evidence of a correct run without the agents' counters. The checker then takes them from the
    traces.
    """
    evidence = simulate(scenario(**EVENTFUL), 3, tracing=True).evidence
    assert evidence.record is not None
    for agent in evidence.record.agents.values():
        agent.messages_sent = agent.bytes_sent = agent.reconciles = agent.chain_changed_at_s = None
    return evidence


def unknown_name(name: str) -> str:
    return f"x-{name}"


def renamings() -> Iterator[tuple[str, Rename]]:
    """Yield a description of each defined name, and a function that replaces this name in a handler run."""
    for name, handler in HANDLERS.items():
        yield f"handler {name}", handler_renamed(name)
        for branch in handler.branches:
            yield f"branch {branch} of {name}", branch_renamed(name, branch)
    for timer in TIMERS:
        yield f"timer {timer}", timer_renamed(timer)
    for message in MESSAGES:
        yield f"message {message}", message_renamed(message)
    for operation in OPERATIONS:
        yield f"operation {operation}", operation_renamed(operation)
    for trigger in KINDS:
        yield f"trigger {trigger}", trigger_renamed(trigger)
    for vote in VOTES:
        yield f"tally {vote}", tally_renamed(vote)


def handler_renamed(name: str) -> Rename:
    def rename(run: HandlerRun) -> HandlerRun:
        trigger = LocalTrigger(unknown_name(name)) if run.trigger == LocalTrigger(name) else run.trigger
        return dataclasses.replace(
            run, handler=unknown_name(name) if run.handler == name else run.handler, trigger=trigger
        )

    return rename


def branch_renamed(name: str, branch: str) -> Rename:
    return lambda run: (
        dataclasses.replace(run, branch=unknown_name(branch)) if (run.handler, run.branch) == (name, branch) else run
    )


def timer_renamed(timer: str) -> Rename:
    def rename(run: HandlerRun) -> HandlerRun:
        trigger = TimerTrigger(unknown_name(timer)) if run.trigger == TimerTrigger(timer) else run.trigger
        started = {unknown_name(name) if name == timer else name: after for name, after in (run.started or {}).items()}
        return dataclasses.replace(run, trigger=trigger, started=started or None)

    return rename


def message_renamed(message: str) -> Rename:
    def rename(run: HandlerRun) -> HandlerRun:
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger) and trigger.message == message:
            trigger = dataclasses.replace(trigger, message=unknown_name(message))
        sent = [
            dataclasses.replace(each, message=unknown_name(message)) if each.message == message else each
            for each in run.sent
        ]
        return dataclasses.replace(run, trigger=trigger, sent=sent)

    return rename


def operation_renamed(operation: str) -> Rename:
    return lambda run: dataclasses.replace(
        run, changes=[(unknown_name(name) if name == operation else name, block) for name, block in run.changes]
    )


def trigger_renamed(kind: str) -> Rename:
    return lambda run: dataclasses.replace(
        run,
        trigger=parse(
            {unknown_name(key) if key == kind else key: value for key, value in run.trigger.to_json().items()}
        ),
    )


def tally_renamed(vote: str) -> Rename:
    return lambda run: (
        dataclasses.replace(run, tally={unknown_name(key) if key == vote else key: n for key, n in run.tally.items()})
        if run.tally
        else run
    )


def with_renamed_steps(evidence: Evidence, rename: Rename, agents: set[int]) -> Evidence:
    """Return the evidence with replaced names in the handler runs of these agents."""
    traces: dict[int, Trace] = {}
    for agent_id, trace in evidence.traces.items():
        runs = [rename(run) for run in trace.runs] if agent_id in agents else trace.runs
        traces[agent_id] = dataclasses.replace(trace, runs=runs)
    before = evidence.before_final_reconcile
    return Evidence(evidence.exports, traces, evidence.record, before_final_reconcile=before)


def test_run_is_correct_and_uses_nearly_every_name(honest: Evidence) -> None:
    assert not check(honest).bad
    unused = [
        label
        for label, rename in renamings()
        if with_renamed_steps(honest, rename, {1, 2, 3, 4}).traces == honest.traces
    ]
    assert all(label.startswith("branch ") for label in unused)
    assert len(unused) < 30


@pytest.mark.parametrize("agents", [{1}, {1, 2, 3, 4}], ids=["one agent", "all"])
def test_unknown_name_causes_no_violation_and_no_zero_figure(honest: Evidence, agents: set[int]) -> None:
    known = check(honest)
    for label, rename in renamings():
        changed = with_renamed_steps(honest, rename, agents)
        if changed.traces == honest.traces:
            continue
        result = check(changed)
        assert not result.bad, (
            label,
            [(result.judgements[key].reason, result.judgements[key].evidence[:2]) for key in result.bad],
        )
        assert any("unknown" in judgement.reason for judgement in result.judgements.values()), label
        for name, figure in result.figures.items():
            assert figure in (known.figures[name], None), (label, name, figure)


def test_wrong_algorithm_number_is_only_a_contradiction_of_records(
    honest: Evidence,
) -> None:
    def misnumber(run: HandlerRun) -> HandlerRun:
        return dataclasses.replace(run, algorithm=7) if run.handler == "receive_commit_block" else run

    result = check(with_renamed_steps(honest, misnumber, {1}))
    assert result.bad == ("records",)
    (finding,) = result.beside["records"].evidence
    assert finding.detail == "its trace has receive_commit_block as Algorithm 7, but it is Algorithm 6"


def test_deviation_is_found_despite_unknown_timers_and_branches(honest: Evidence) -> None:
    def rename_branch_and_timers(run: HandlerRun) -> HandlerRun:
        for timer in TIMERS:
            run = timer_renamed(timer)(run)
        return dataclasses.replace(run, branch=unknown_name(run.branch))

    changed = with_renamed_steps(honest, rename_branch_and_timers, {1})
    assert not check(changed).bad
    runs = changed.traces[1].runs
    position = next(
        position for position, run in enumerate(runs) if run.handler == "vote_timer_expiration" and run.changes
    )
    runs[position] = dataclasses.replace(runs[position], sent=[])
    judgement = check(changed).beside["steps"]
    assert judgement.verdict == "deviates"
    (finding, *_) = judgement.evidence
    assert "it sent nothing; it should have sent Commit Block" in finding.detail


def test_losses_are_unknown_if_completed_blocks_are_unknown(honest: Evidence) -> None:
    changed = with_renamed_steps(honest, operation_renamed("complete"), {2})
    survived = survival(changed)
    assert (survived.completed, survived.gone, survived.losses[0].completed) == (None, None, None)
    assert "the number of lost completed blocks is unknown" in " ".join(in_words(survived))
    assert check(changed).figures["blocks"] is None


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a run in which agent 1 uses undefined names for its vote timer, a branch, and a completed block."""
    path = tmp_path_factory.mktemp("run") / "run"
    assert not run(scenario(**EVENTFUL), 3, path, SilentProgress(), "sim").result.bad
    for agent, old, new in (
        (1, '{"timer":"voting"}', '{"timer":"vote"}'),
        (3, '"branch":"building"', '"branch":"builds"'),
        (4, '["complete",', '["done",'),
    ):
        trace = path / "agents" / f"{agent}.trace.jsonl"
        text = trace.read_text()
        assert old in text
        trace.write_text(text.replace(old, new))
    return path


def test_report_names_the_steps_that_it_omits(directory: Path) -> None:
    page = write_report(RunArchive(directory)).read_text()
    assert "some steps of agent 1 are not shown: unknown timer name &#39;vote&#39; in its trace" in page
    assert "and such words in 2 more" in page
    assert "The traces contain unknown words, so there may be more" in page


@pytest.mark.parametrize(("agent", "because"), [(1, "unknown timer name 'vote'"), (3, "unknown branch 'builds' of")])
def test_replay_reports_no_violation_for_an_unknown_name(directory: Path, agent: int, because: str) -> None:
    found = RecordPlayer(open_record(directory / "agents" / f"{agent}.trace.jsonl")).to_end()
    assert not found.deviations
    assert found.steps
    assert found.unjudged
    assert because in found.lost[0]


def test_reconstruction_plays_an_agent_up_to_an_unknown_name(directory: Path, tmp_path: Path) -> None:
    ended = harness("reconstruct", directory, "--out", tmp_path / "again.yaml")
    output = ended.stdout + ended.stderr
    assert "agent 4 can be played only in part: line" in output
    assert "unknown operation 'done'" in output
    assert "agent 1" not in output, "the handler determines the timer"
    assert "deviates from the protocol" not in output
