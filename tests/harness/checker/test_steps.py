"""Test the comparison of each agent's steps with the reference implementation."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.archive.traces import HANDLER_RUN, Trace, TraceHeader
from harness.checker import Evidence, steps
from harness.checker.judgement import Judgement
from harness.run.simulate import simulate
from tests.harness.virtual import scenario
from ucp.agent import HANDLERS, ON_LOCAL_EVENT, Agent
from ucp.block import Block
from ucp.core import Core
from ucp.handler import EventHandler
from ucp.messages import TYPE_CODES
from ucp.quirks import CRASHED, QUIRKS, Quirk
from ucp.store import StoredState
from ucp.trace import SCHEMA, DroppedDatagram, HandlerRun, RecordedBytes, in_base64
from ucp.trigger import EventTrigger, LocalTrigger, TimerTrigger, UnknownTrigger

LOSSY = {"network": {"loss": 0.25}, "duration_s": 600}


@pytest.fixture(scope="module")
def honest() -> Evidence:
    return simulate(scenario(**LOSSY), 1, tracing=True).evidence


def with_traces(evidence: Evidence, traces: dict[int, Trace]) -> Evidence:
    return Evidence(evidence.exports, traces, evidence.record)


def edited(evidence: Evidence, agent: int, change: Callable[[list[HandlerRun]], Any]) -> Evidence:
    """Return the evidence with the trace of one agent changed."""
    runs = [HANDLER_RUN.validate_json(run.to_line()) for run in evidence.traces[agent].runs]
    change(runs)
    return with_traces(evidence, {**evidence.traces, agent: dataclasses.replace(evidence.traces[agent], runs=runs)})


def judged(**keys: Any) -> Judgement:
    return simulate(scenario(**keys), 1, tracing=True).result.beside["steps"]


def first_run(runs: list[HandlerRun], handler: str, branch: str = "") -> HandlerRun:
    return next(run for run in runs if run.handler == handler and branch in ("", run.branch))


def proposal(runs: list[HandlerRun]) -> HandlerRun:
    return first_run(runs, "process_next_deque_block", "proposed")


def expiry(runs: list[HandlerRun]) -> HandlerRun:
    return first_run(runs, "vote_timer_expiration")


def commit(runs: list[HandlerRun]) -> HandlerRun:
    return first_run(runs, "receive_commit_block")


def without_expiry(runs: list[HandlerRun]) -> None:
    """Remove the first expiry of a vote timer, and all handler runs that this expiry triggered."""
    position = runs.index(expiry(runs))
    del runs[position]
    while runs[position].trigger.kind == "local":
        del runs[position]


def test_unaltered_run_is_as_specified(honest: Evidence) -> None:
    judgement = steps.check(honest)
    assert judgement.verdict == "as specified"
    assert judgement.reason.startswith(f"{sum(len(trace.runs) for trace in honest.traces.values())} handler runs")


@pytest.mark.parametrize(
    "keys",
    [
        {"clocks": {2: {"offset_s": -2, "drift": 0.01}, 3: {"offset_s": 5, "drift": -0.01}}},
        {"settings": {"phase1_tie": "pop", "phase2_tie": "block", "vote_names_chain": True, "finalize_gap_s": 0}},
        {"settings": {"changed_before_tally": True, "vote_timeout_s": 3, "max_block_bytes": 300}},
        {
            "settings": {"asks_after_commit": True, "top_needs_majority": True, "max_block_bytes": 300},
            "network": {"loss": 0.2},
        },
        {"timeline": [{"at_s": 200, "reboot": [2], "down_s": 30, "disk": "kept"}, {"at_s": 250, "kill": [3]}]},
        {"timeline": [{"at_s": 200, "kill": [2]}, {"at_s": 300, "restart": [2]}]},
        {"timeline": [{"at_s": 200, "pause": [4]}, {"at_s": 300, "resume": [4]}]},
        {"network": {"loss": 0.1, "duplicate": 0.3, "reorder": 0.2, "delay": 0.5}},
    ],
    ids=["clocks", "readings", "timers", "asking", "reboot", "restart", "pause", "netem"],
)
def test_settings_clocks_and_faults_are_no_deviation(keys: dict[str, Any]) -> None:
    judgement = judged(**{**LOSSY, **keys})
    assert judgement.verdict == "as specified", judgement


@pytest.mark.parametrize(
    ("quirk", "handler", "sentence"),
    [
        ("crash_on_tie", "reconcile_phase_2_timer_expiration", "it took the branch 'crashed by quirk'"),
        ("early_phase3_expiry", "reconcile_phase_3", "started the phase three timer for 0 s; it should have started"),
        ("stale_chain_hash", "receive_response_block_for_hash", "it had the top chain hash "),
        ("commit_whatever_the_vote", "vote_timer_expiration", "it should have taken 'not approved'"),
        ("forget_own_vote", "process_next_deque_block", "it counted yes 0, no 0; it should have counted yes 1, no 0"),
        ("hide_commits", "vote_timer_expiration", "it sent nothing; it should have sent Commit Block about block "),
        ("approve_everything", "receive_request_add_block", "saying approve True"),
        ("commit_without_succession", "receive_commit_block", "it should have taken 'does not succeed'"),
        ("wrong_event", "receive_response_block_for_hash", "it triggered Reconcile Phase 1; it should have triggered"),
        ("give_up_unfinished", "reconcile_phase_3_timer_expiration", "it triggered nothing; it should have triggered"),
    ],
)
def test_wrong_agent_is_reported_at_its_first_deviation(quirk: str, handler: str, sentence: str) -> None:
    judgement = judged(network={"loss": 0.3}, duration_s=1200, quirks={quirk: True})
    assert judgement.verdict == "deviates"
    assert judgement.evidence[0].handler == handler
    assert f"Algorithm {HANDLERS[handler].algorithm}, {handler}" in judgement.evidence[0].detail
    assert sentence in judgement.evidence[0].detail


def test_one_mistake_is_one_finding(honest: Evidence) -> None:
    def disapprove_once(runs: list[HandlerRun]) -> None:
        first_run(runs, "receive_request_add_block", "approve").branch = "disapprove"

    judgement = steps.check(edited(honest, 2, disapprove_once))
    assert judgement.reason.startswith("1 difference in ")
    (finding,) = judgement.evidence
    assert finding.agent_id == 2
    assert "it took the branch 'disapprove'; it should have taken 'approve'" in finding.detail


def test_agent_is_followed_from_its_own_state_after_a_deviation(honest: Evidence) -> None:
    """Let an agent ignore commits, so that its chain is shorter from then on. Each ignored commit counts as one
    difference.
    """
    simulated = simulate(scenario(**LOSSY, quirks={"ignore_commit": 0.1}), 1, tracing=True)
    ignored = sum(
        run.branch == "ignored by quirk" for trace in simulated.evidence.traces.values() for run in trace.runs
    )
    judgement = simulated.result.beside["steps"]
    assert ignored > 1
    assert judgement.reason.startswith(f"{ignored} differences in ")
    assert {finding.handler for finding in judgement.evidence} == {"receive_commit_block"}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda runs: runs.remove(proposal(runs)), "it triggered nothing; it should have triggered Process Next"),
        (lambda runs: runs.remove(expiry(runs)), "it ran without a trigger"),
        (lambda runs: without_expiry(runs), "it did not run, although the voting timer expired at t="),
        (
            lambda runs: setattr(expiry(runs), "handler", "receive_vote_add_block"),
            "it ran as Algorithm 4, but the input is for Algorithm 5",
        ),
        (lambda runs: setattr(expiry(runs), "t", expiry(runs).t - 3), "s before the voting timer expired"),
        (
            lambda runs: setattr(expiry(runs), "trigger", TimerTrigger("finalize gap")),
            "at the expiry of the finalize gap timer, which was not running",
        ),
        (lambda runs: setattr(expiry(runs), "trigger", UnknownTrigger({})), "it ran without a known trigger"),
        (
            lambda runs: setattr(first_run(runs, "build_data_block"), "trigger", EventTrigger(255)),
            "recorded the event 255",
        ),
        (
            lambda runs: setattr(first_run(runs, "build_data_block"), "trigger", LocalTrigger("reconcile_begin")),
            "it ran without a trigger",
        ),
        (lambda runs: setattr(commit(runs).trigger, "sequence", 77), "it recorded Commit Block 77 from agent"),
        (lambda runs: setattr(commit(runs), "input", RecordedBytes("!")), "a datagram that it must drop: not base64"),
        (lambda runs: setattr(commit(runs), "input", None), "a datagram that it must drop: truncated"),
        (lambda runs: proposal(runs).sent.clear(), "it sent nothing; it should have sent"),
        (lambda runs: setattr(proposal(runs).sent[0], "seq", 9), "with sequence number 9"),
        (lambda runs: runs.insert(9, HANDLER_RUN.validate_json(runs[9].to_line())), "; it should have "),
    ],
)
def test_missing_or_superfluous_parts_of_a_trace_are_found(
    honest: Evidence, change: Callable[[list[HandlerRun]], Any], sentence: str
) -> None:
    judgement = steps.check(edited(honest, 4, change))
    assert judgement.verdict == "deviates"
    assert any(sentence in finding.detail for finding in judgement.evidence), judgement.evidence


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_changed_line_of_a_trace_is_found(honest: Evidence, data: st.DataObject) -> None:
    agent = data.draw(st.sampled_from(sorted(honest.traces)))
    number = data.draw(st.integers(0, len(honest.traces[agent].runs) - 1))
    document = json.loads(honest.traces[agent].runs[number].to_line())
    key = data.draw(st.sampled_from(["branch", "handler", "state", "changes"]))
    if key == "state":
        part = data.draw(st.sampled_from(["chain", "deque", "stack", "top"]))
        document["state"][part] = "00" * 32 if part == "top" else document["state"][part] + 1
    elif key == "changes":
        document["changes"] = [*document["changes"], ["chain+", "00" * 32]]
    else:
        others = [name for name, handler in HANDLERS.items() if key == "handler" and name != document["handler"]]
        others = others or [*{*HANDLERS[document["handler"]].branches, CRASHED} - {document["branch"]}]
        document[key] = data.draw(st.sampled_from(sorted(others)))
    changed = edited(honest, agent, lambda runs: runs.__setitem__(number, HANDLER_RUN.validate_python(document)))
    judgement = steps.check(changed)
    assert judgement.verdict == "deviates"
    assert any(finding.agent_id == agent for finding in judgement.evidence)


def test_handler_run_in_memory_equals_its_line(honest: Evidence) -> None:
    for trace in honest.traces.values():
        read = [HANDLER_RUN.validate_json(run.to_line()) for run in trace.runs]
        assert read == [dataclasses.replace(run, t=round(run.t, 6)) for run in trace.runs]


def test_dropped_valid_datagram_is_found(honest: Evidence) -> None:
    trace = honest.traces[3]
    request = first_run(trace.runs, "receive_request_add_block")
    assert request.input is not None
    asides = [
        (1, DroppedDatagram(1.0, "wrong length", request.input)),
        (1, DroppedDatagram(1.0, "truncated", RecordedBytes("AAAA"))),
    ]
    judgement = steps.check(with_traces(honest, {**honest.traces, 3: dataclasses.replace(trace, asides=asides)}))
    (finding,) = judgement.evidence
    assert "trace line 3" in finding.detail
    assert "it dropped a Block Add Request of agent" in finding.detail


def test_tallies_and_started_timers_are_optional(honest: Evidence) -> None:
    def silent(runs: list[HandlerRun]) -> None:
        for run in runs:
            run.tally = run.started = None

    def votes_only(runs: list[HandlerRun]) -> None:
        for run in runs:
            run.tally = run.tally if run.algorithm in (2, 4) else None
            run.t = round(run.t, 3)

    assert steps.check(edited(honest, 1, silent)).verdict == "as specified"
    assert steps.check(edited(honest, 1, votes_only)).verdict == "as specified"


def test_missing_start_of_a_timer_is_found(honest: Evidence) -> None:
    def start_nothing(runs: list[HandlerRun]) -> None:
        first_run(runs, "process_next_deque_block", "proposed").started = None

    judgement = steps.check(edited(honest, 1, start_nothing))
    assert "it started no timer; it should have started the voting timer for 10 s" in judgement.evidence[0].detail


def test_trace_of_version_1_is_not_judged(honest: Evidence) -> None:
    header = TraceHeader.model_validate(honest.traces[2].header.model_dump() | {"schema": "ucp-trace/1"})
    old = dataclasses.replace(honest.traces[2], header=header)
    judgement = steps.check(with_traces(honest, {**honest.traces, 2: old}))
    assert judgement.verdict == "not applicable"
    assert judgement.reason == "of agent 2 the trace has the version ucp-trace/1, which lacks received messages"


def test_agent_with_a_setting_that_the_reference_lacks_is_not_judged(honest: Evidence) -> None:
    trace = honest.traces[1]
    header = trace.header.model_copy(update={"settings": {**trace.header.settings, "votes_twice": True}})
    judgement = steps.check(with_traces(honest, {**honest.traces, 1: dataclasses.replace(trace, header=header)}))
    assert judgement.verdict == "not applicable"
    assert judgement.reason == "of agent 1 the settings include votes_twice, which the reference lacks"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vote_timeout_s", True),
        ("phase3_timeout_s", 2e9),
        ("finalize_gap_s", -0.1),
        ("max_block_bytes", 600.0),
        ("max_event_bytes", 1025),
        ("phase1_tie", "push"),
        ("vote_names_chain", 1),
        ("answer_spread_s", 5.0),
        ("answer_spread_s", math.nan),
    ],
)
def test_impossible_setting_is_a_deviation(honest: Evidence, name: str, value: object) -> None:
    trace = honest.traces[1]
    header = trace.header.model_copy(update={"settings": {**trace.header.settings, name: value}})
    judgement = steps.check(with_traces(honest, {**honest.traces, 1: dataclasses.replace(trace, header=header)}))
    assert judgement.verdict == "deviates"
    assert f"the header of its trace has invalid settings: {name} is " in judgement.evidence[0].detail


def test_missing_trace_makes_steps_not_applicable(honest: Evidence) -> None:
    assert steps.check(with_traces(honest, {})).verdict == "not applicable"
    some = {agent: trace for agent, trace in honest.traces.items() if agent != 5}
    judgement = steps.check(with_traces(honest, some))
    assert (judgement.verdict, judgement.reason) == ("not applicable", "of agent 5 there is no trace")


def test_impossible_header_is_a_deviation(honest: Evidence) -> None:
    trace = honest.traces[1]
    for part, sentence in (
        ({"settings": {"vote_timeout_s": -1}}, "the header of its trace has invalid settings"),
        ({"clock": {"speedup": 0}}, "clock"),
    ):
        header = trace.header.model_copy(update=part)
        judgement = steps.check(with_traces(honest, {**honest.traces, 1: dataclasses.replace(trace, header=header)}))
        assert judgement.verdict == "deviates"
        assert sentence in judgement.evidence[0].detail


def test_agent_with_an_unrecorded_block_is_not_followed(honest: Evidence) -> None:
    def conjure(runs: list[HandlerRun]) -> None:
        runs[3].changes.append(("chain+", "ab" * 32))
        runs[3].state.chain += 1

    judgement = steps.check(edited(honest, 1, conjure))
    assert (
        "after trace line 5 agent 1 cannot be followed: the data of block abababababab is not recorded"
        in judgement.reason
    )


def test_agent_is_followed_after_a_wrong_boot() -> None:
    agent = Agent(1, [1, 2], b"mission")
    stack = [Block(1, 5, b"below"), Block(1, 6, b"above")]
    agent.boot(StoredState(completed=[block.block_hash for block in stack], stack=stack), 0.0)
    agent.handle_timer(1.0)
    header = {"schema": SCHEMA, "agent_id": 1, "roster": [1, 2], "initial_data": in_base64(b"mission"), "clock": {}}
    trace = Trace(TraceHeader.model_validate({**header, "settings": dataclasses.asdict(agent.state.settings)}))
    trace.extend(agent.trace())
    trace.runs[0].branch = "done"
    judgement = steps.check(Evidence({}, {1: trace}))
    assert judgement.reason.startswith(f"1 difference in {len(trace.runs)} handler runs")
    (finding,) = judgement.evidence
    assert "it took the branch 'done'; it should have taken 'recommitted, more to come'" in finding.detail


def left_out(good: Any, core: Core, *inputs: object, branch: str) -> str:
    """Do nothing, and return the branch. The function replaces a handler."""
    return branch


def done_twice(good: Any, core: Core, *inputs: object) -> str:
    good(core, *inputs)
    branch: str = good(core, *inputs)
    return branch


def nothing(good: Any, core: Core, *arguments: object) -> None:
    """Do nothing. The function replaces an operation of the agent."""


def mistakes(handler: EventHandler[Any]) -> Iterator[Quirk]:
    """Yield simple errors of this handler: it does nothing, it runs twice, or it omits one kind of action."""
    wrong = {f"takes {branch}": partial(left_out, branch=branch) for branch in handler.branches}
    for name, run in {**wrong, "twice": done_twice}.items():
        yield mistake(handler, name, run, None)
    for helper in ("send", "trigger", "start", "commit", "push_onto_deque", "take_from_deque", "pop_to_stack"):
        yield mistake(handler, f"no {helper}", nothing, helper)


def mistake(handler: EventHandler[Any], name: str, wrong: Callable[..., Any], helper: str | None) -> Quirk:
    may = (
        tuple(TYPE_CODES),
        ("voting", "phase one", "phase two", "phase three", "finalize gap"),
        tuple(ON_LOCAL_EVENT),
    )
    return Quirk(name, name, (handler.algorithm,), wrong, helper, (), *may, chance=False)


def trace_lines(evidence: Evidence) -> list[str]:
    return [run.to_line() for _, trace in sorted(evidence.traces.items()) for run in trace.runs]


@pytest.fixture(scope="module")
def right() -> list[str]:
    return trace_lines(simulate(scenario(**LOSSY), 1, tracing=True, deliver_all=True).evidence)


@pytest.mark.parametrize("handler", HANDLERS.values(), ids=lambda handler: handler.name)
def test_omitted_or_doubled_actions_of_a_handler_are_found(
    handler: EventHandler[Any], right: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Skip errors that do not change this mission."""
    different = 0
    for quirk in mistakes(handler):
        monkeypatch.setitem(QUIRKS, quirk.name, quirk)
        run = simulate(scenario(**LOSSY, settle={"limit_s": 100}, quirks={quirk.name: True}), 1, tracing=True)
        if trace_lines(run.evidence) == right:
            continue
        different += 1
        judgement = run.result.beside["steps"]
        assert judgement.verdict == "deviates", quirk.name
        assert judgement.evidence[0].handler == handler.name, (quirk.name, judgement.evidence[0].detail)
    assert different


def test_unknown_handlers_are_not_judged_and_the_reason_is_short(honest: Evidence) -> None:
    def rename(runs: list[HandlerRun]) -> None:
        for number, run in enumerate(runs):
            run.handler = f"handler_{number}" * 20

    judgement = steps.check(edited(honest, 3, rename))
    assert judgement.verdict == "not applicable"
    assert judgement.reason.startswith("of agent 3 the trace has unknown words: unknown handler name 'handler_0")
    assert len(judgement.reason) < 500


def test_deviation_before_an_unknown_handler_is_found(honest: Evidence) -> None:
    def first_wrong_then_unknown(runs: list[HandlerRun]) -> None:
        proposal(runs).sent.clear()
        runs[-1].handler = "no_handler"

    judgement = steps.check(edited(honest, 3, first_wrong_then_unknown))
    assert judgement.verdict == "deviates"
    assert "it sent nothing; it should have sent" in judgement.evidence[0].detail


def test_step_with_an_unknown_branch_is_compared_otherwise(honest: Evidence) -> None:
    def rename_branches(runs: list[HandlerRun]) -> None:
        for run in runs:
            run.branch = run.branch.upper()

    judgement = steps.check(edited(honest, 3, rename_branches))
    assert (judgement.verdict, "unknown branch 'BUILDING' of build_data_block" in judgement.reason) == (
        "not applicable",
        True,
    )
    judgement = steps.check(
        edited(honest, 3, lambda runs: (rename_branches(runs), proposal_in_capitals(runs).sent.clear()))
    )
    assert judgement.verdict == "deviates"
    (finding, *_) = judgement.evidence
    assert "branch" not in finding.detail


def proposal_in_capitals(runs: list[HandlerRun]) -> HandlerRun:
    return first_run(runs, "process_next_deque_block", "PROPOSED")


@pytest.mark.parametrize("moment", [math.nan, math.inf, -1e300, 1e300])
def test_impossible_time_causes_no_exception(honest: Evidence, moment: float) -> None:
    steps.check(edited(honest, 2, lambda runs: setattr(runs[7], "t", moment)))
