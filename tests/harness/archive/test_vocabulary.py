"""A word that nobody knows is no accusation and makes no figure silently 0; a wrong number of a handler is found."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from harness.archive.archive import RunArchive
from harness.archive.traces import Trace
from harness.archive.vocabulary import MESSAGES, OPERATIONS, TIMERS, VOTES
from harness.checker import Evidence, check
from harness.checker.survival import in_words, survival
from harness.field.replay import Player, open_record
from harness.play.progress import Silent
from harness.report._run_page import write_report
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
    """Of a run in which nothing is wrong; its record lacks what agents counted, which is then taken from traces."""
    evidence = simulate(scenario(**EVENTFUL), 3, tracing=True).evidence
    assert evidence.record is not None
    for agent in evidence.record.agents.values():
        agent.messages_sent = agent.bytes_sent = agent.reconciles = agent.chain_changed_at_s = None
    return evidence


def foreign(word: str) -> str:
    return f"x-{word}"


def words() -> Iterator[tuple[str, Rename]]:
    """Each word of the vocabulary, and how an agent says it that has another one for it."""
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
        trigger = LocalTrigger(foreign(name)) if run.trigger == LocalTrigger(name) else run.trigger
        return dataclasses.replace(run, handler=foreign(name) if run.handler == name else run.handler, trigger=trigger)

    return rename


def branch_renamed(name: str, branch: str) -> Rename:
    return lambda run: (
        dataclasses.replace(run, branch=foreign(branch)) if (run.handler, run.branch) == (name, branch) else run
    )


def timer_renamed(timer: str) -> Rename:
    def rename(run: HandlerRun) -> HandlerRun:
        trigger = TimerTrigger(foreign(timer)) if run.trigger == TimerTrigger(timer) else run.trigger
        started = {foreign(name) if name == timer else name: after for name, after in (run.started or {}).items()}
        return dataclasses.replace(run, trigger=trigger, started=started or None)

    return rename


def message_renamed(message: str) -> Rename:
    def rename(run: HandlerRun) -> HandlerRun:
        trigger = run.trigger
        if isinstance(trigger, MessageTrigger) and trigger.message == message:
            trigger = dataclasses.replace(trigger, message=foreign(message))
        sent = [
            dataclasses.replace(each, message=foreign(message)) if each.message == message else each
            for each in run.sent
        ]
        return dataclasses.replace(run, trigger=trigger, sent=sent)

    return rename


def operation_renamed(operation: str) -> Rename:
    return lambda run: dataclasses.replace(
        run, changes=[(foreign(name) if name == operation else name, block) for name, block in run.changes]
    )


def trigger_renamed(kind: str) -> Rename:
    return lambda run: dataclasses.replace(
        run,
        trigger=parse({foreign(key) if key == kind else key: value for key, value in run.trigger.to_json().items()}),
    )


def tally_renamed(vote: str) -> Rename:
    return lambda run: (
        dataclasses.replace(run, tally={foreign(key) if key == vote else key: n for key, n in run.tally.items()})
        if run.tally
        else run
    )


def told_by(evidence: Evidence, rename: Rename, agents: set[int]) -> Evidence:
    """The evidence, if these agents had told it so."""
    traces: dict[int, Trace] = {}
    for agent_id, trace in evidence.traces.items():
        told = [rename(run) for run in trace.runs] if agent_id in agents else trace.runs
        traces[agent_id] = dataclasses.replace(trace, runs=told)
    before = evidence.before_final_reconcile
    return Evidence(evidence.exports, traces, evidence.record, before_final_reconcile=before)


def test_the_run_is_sound_and_takes_nearly_every_word(honest: Evidence) -> None:
    assert not check(honest).bad
    unsaid = [word for word, rename in words() if told_by(honest, rename, {1, 2, 3, 4}).traces == honest.traces]
    assert all(word.startswith("branch ") for word in unsaid)
    assert len(unsaid) < 30


@pytest.mark.parametrize("agents", [{1}, {1, 2, 3, 4}], ids=["one agent", "all"])
def test_no_unknown_word_is_an_accusation_or_makes_a_figure_0(honest: Evidence, agents: set[int]) -> None:
    known = check(honest)
    for word, rename in words():
        told = told_by(honest, rename, agents)
        if told.traces == honest.traces:
            continue
        result = check(told)
        assert not result.bad, (
            word,
            [(result.judgements[key].reason, result.judgements[key].evidence[:2]) for key in result.bad],
        )
        assert any("unknown" in judgement.reason for judgement in result.judgements.values()), word
        for name, figure in result.figures.items():
            assert figure in (known.figures[name], None), (word, name, figure)


def test_a_known_handler_with_another_s_number_is_a_contradiction_in_the_evidence_and_nothing_else(
    honest: Evidence,
) -> None:
    def misnumber(run: HandlerRun) -> HandlerRun:
        return dataclasses.replace(run, algorithm=7) if run.handler == "receive_commit_block" else run

    result = check(told_by(honest, misnumber, {1}))
    assert result.bad == ("records",)
    (finding,) = result.beside["records"].evidence
    assert finding.detail == "its trace has receive_commit_block as Algorithm 7, but it is Algorithm 6"


def test_a_mistake_is_found_though_timers_and_branches_have_other_names(honest: Evidence) -> None:
    def otherwise(run: HandlerRun) -> HandlerRun:
        for timer in TIMERS:
            run = timer_renamed(timer)(run)
        return dataclasses.replace(run, branch=foreign(run.branch))

    told = told_by(honest, otherwise, {1})
    assert not check(told).bad
    runs = told.traces[1].runs
    position = next(
        position for position, run in enumerate(runs) if run.handler == "vote_timer_expiration" and run.changes
    )
    runs[position] = dataclasses.replace(runs[position], sent=[])
    judgement = check(told).beside["steps"]
    assert judgement.verdict == "deviates"
    (finding, *_) = judgement.evidence
    assert "it sent nothing; it should have sent Commit Block" in finding.detail


def test_what_was_lost_is_not_known_where_nobody_knows_what_was_completed(honest: Evidence) -> None:
    told = told_by(honest, operation_renamed("complete"), {2})
    survived = survival(told)
    assert (survived.completed, survived.gone, survived.losses[0].completed) == (None, None, None)
    assert "the number of lost completed blocks is unknown" in " ".join(in_words(survived))
    assert check(told).figures["blocks"] is None


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of which agent 1 has other words for its voting timer, for a branch, and for what it completes."""
    path = tmp_path_factory.mktemp("run") / "run"
    assert not run(scenario(**EVENTFUL), 3, path, Silent(), "sim").result.bad
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


def test_a_report_says_that_it_does_not_show_all(directory: Path) -> None:
    page = write_report(RunArchive(directory)).read_text()
    assert "some steps of agent 1 are not shown: unknown timer name &#39;vote&#39; in its trace" in page
    assert "and such words in 2 more" in page
    assert "The traces contain unknown words, so there may be more" in page


@pytest.mark.parametrize(("agent", "because"), [(1, "unknown timer name 'vote'"), (3, "unknown branch 'builds' of")])
def test_a_replay_accuses_nobody_over_a_word(directory: Path, agent: int, because: str) -> None:
    found = Player(open_record(directory / "agents" / f"{agent}.trace.jsonl")).to_end()
    assert not found.deviations
    assert found.steps
    assert found.unjudged
    assert because in found.lost[0]


def test_a_reconstruction_plays_an_agent_up_to_the_first_line_that_nobody_understands(
    directory: Path, tmp_path: Path
) -> None:
    ended = harness("reconstruct", directory, "--out", tmp_path / "again.yaml")
    said = ended.stdout + ended.stderr
    assert "agent 4 can be played only in part: line" in said
    assert "unknown operation 'done'" in said
    assert "agent 1" not in said, "which timer ended, its handler tells"
    assert "deviates from the protocol" not in said
