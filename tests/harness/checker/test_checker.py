"""Test the checks of all characteristics.

Each characteristic holds for a good run and is violated by a manipulated run. None holds without evidence.
"""

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.archive.archive import RunArchive
from harness.checker import Result, check, gather
from tests.harness.mission import CONNECTED, LOSSY, edit, edit_lines, fly, reconcile_all, write_exports, write_run
from tests.ucp.air import Air
from ucp.messages import CommitBlock


def verdicts(result: Result) -> str:
    """Return one letter for the verdict on each characteristic: h (holds), v (violated), or n (not applicable)."""
    return "".join(result.characteristics[number].verdict[0] for number in "123456")


def reason(result: Result, number: str) -> str:
    return result.characteristics[number].reason


@pytest.fixture(scope="module")
def perfect() -> Air:
    return fly()


@pytest.fixture
def run_dir(perfect: Air, tmp_path: Path) -> Path:
    return write_run(perfect, tmp_path / "run", CONNECTED)


def test_perfect_run_holds_in_all_six(run_dir: Path) -> None:
    result = check(gather(RunArchive(run_dir)))
    assert verdicts(result) == "hhhhhh"
    assert result.figures["distinct_chains"] == 1
    assert result.figures["mutual_chain"] == result.figures["blocks"] == result.figures["longest_chain"]
    assert result.figures["copies_min"] == result.figures["copies_mean"] == 5
    assert result.figures["reconciles"] == 0
    assert not result.errors


def test_exports_alone_make_1_not_applicable(perfect: Air, tmp_path: Path) -> None:
    paths = write_exports(perfect, tmp_path, traces=False)
    result = check(gather(RunArchive(*paths)))
    assert verdicts(result) == "nhhhhh"
    assert result.figures["messages"] is None


def test_different_chains_after_loss_make_5_and_6_not_applicable(tmp_path: Path) -> None:
    air = fly(loss=0.3, seed=3)
    assert len(set(air.chains())) > 1
    result = check(gather(RunArchive(write_run(air, tmp_path / "before", LOSSY))))
    assert verdicts(result) == "hhhhnn"
    assert "loss 15 %" in reason(result, "6")
    assert result.figures["distinct_chains"] == len(set(air.chains()))
    began = air.now
    reconcile_all(air)
    healed = [*LOSSY, {"at_s": began, "what": "final reconcile", "detail": "loss 0 %", "fully_connected": True}]
    result = check(gather(RunArchive(write_run(air, tmp_path / "after", healed))))
    assert verdicts(result) == "hhhhhh"


def missed_last_block(reconcile_before: bool = False) -> Air:
    """Return a swarm that loses one commit and never votes afterwards. The chain of agent 2 therefore stays
    different.
    """
    air = Air([1, 2, 3])
    air.fill_block(1)
    air.settle()
    if reconcile_before:
        air.reconcile(2)
    latency = air.fate
    air.fate = lambda s, r, m: [] if isinstance(m, CommitBlock) and r == 2 else latency(s, r, m)
    air.fill_block(3)
    air.settle()
    air.fate = latency
    return air


@pytest.mark.parametrize("reconcile_before", [False, True])
def test_difference_without_a_later_vote_makes_5_and_6_not_applicable(tmp_path: Path, reconcile_before: bool) -> None:
    result = check(gather(RunArchive(write_run(missed_last_block(reconcile_before), tmp_path / "run", CONNECTED))))
    assert verdicts(result) == "hhhhnn"
    assert re.fullmatch(
        r"2 distinct chains, which share 1 block; agent 2 completed no reconcile that began after [\d.]+ s, when the "
        r"chain of agent [13] changed last, and proposed no block since",
        reason(result, "6"),
    )
    assert reason(result, "5").startswith(
        "agent 2 lacks 1 copy of completed blocks, the first of block 3.1; agent 2 completed"
    )


def test_difference_after_a_reconcile_violates_5_and_6(tmp_path: Path) -> None:
    air = missed_last_block()
    agent = air.agents[2]
    agent.begin_reconcile(air.now)
    agent.messages_to_send()  # discard the messages, although the record has a perfect radio
    air.flush(2)
    air.settle()
    result = check(gather(RunArchive(write_run(air, tmp_path / "run", CONNECTED))))
    assert verdicts(result)[4:] == "vv"
    (finding,) = result.characteristics["5"].evidence
    assert (finding.agent_id, finding.block) == (2, "3.1")


def test_exports_alone_do_not_show_whether_the_system_was_connected(tmp_path: Path) -> None:
    paths = write_exports(missed_last_block(), tmp_path, traces=False)
    result = check(gather(RunArchive(*paths)))
    assert verdicts(result)[4:] == "nn"
    assert "exports do not show whether" in reason(result, "6")


def test_agent_that_is_not_idle_makes_2_5_and_6_not_applicable(tmp_path: Path) -> None:
    air = Air([1, 2])
    air.fill_block(1)
    result = check(gather(RunArchive(write_run(air, tmp_path / "run", CONNECTED))))
    assert verdicts(result) == "hnhhnn"
    assert "agent 1 was not idle at the end" in reason(result, "2")


def test_missing_export_makes_2_3_5_and_6_not_applicable(run_dir: Path) -> None:
    (run_dir / "agents" / "4.chain.json").unlink()
    result = check(gather(RunArchive(run_dir)))
    assert verdicts(result) == "hnnhnn"
    assert "the export of agent 4 is missing" in reason(result, "6")


def test_idle_agent_with_an_uncommitted_block_violates_2(run_dir: Path) -> None:
    def hide(export: dict) -> None:
        export["blocks_to_be_committed"].append({**export["chain"].pop(), "chain_hash": None})

    edit(run_dir / "agents" / "2.chain.json", hide)
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["2"].verdict == "violated"
    assert result.characteristics["2"].evidence[0].agent_id == 2


def test_idle_state_with_a_full_deque_in_a_trace_violates_2(run_dir: Path) -> None:
    def claim_idle(lines: list[dict]) -> None:
        voting = next(line for line in lines[1:] if line["state"]["deque"])
        voting["state"]["idle"] = True

    edit_lines(run_dir / "agents" / "1.trace.jsonl", claim_idle)
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["2"].verdict == "violated"
    assert "trace line" in result.characteristics["2"].evidence[0].detail


def test_second_copy_in_an_export_violates_3(run_dir: Path) -> None:
    def copy(export: dict) -> None:
        export["reconcile_stack"].append({**export["chain"][0], "chain_hash": None})

    edit(run_dir / "agents" / "3.chain.json", copy)
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["3"].verdict == "violated"
    (finding,) = result.characteristics["3"].evidence
    assert finding.agent_id == 3
    assert finding.block is not None


def test_second_copy_at_one_step_of_a_trace_violates_3(run_dir: Path) -> None:
    def copy(lines: list[dict]) -> None:
        commit = next(line for line in lines[1:] if line["handler"] == "receive_commit_block" and line["changes"])
        commit["changes"].append(["stack+", commit["changes"][0][1]])

    edit_lines(run_dir / "agents" / "5.trace.jsonl", copy)
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["3"].verdict == "violated"


def test_edited_block_violates_4(run_dir: Path) -> None:
    edit(run_dir / "agents" / "1.chain.json", lambda export: export["chain"][2].update(timestamp_us=1))
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["4"].verdict == "violated"
    assert "does not match its block hash" in result.characteristics["4"].evidence[0].detail


def test_reordered_chain_violates_4(run_dir: Path) -> None:
    edit(run_dir / "agents" / "1.chain.json", lambda export: export["chain"].insert(0, export["chain"].pop(1)))
    result = check(gather(RunArchive(run_dir)))
    assert "the chain hash at block" in result.characteristics["4"].evidence[0].detail


def test_block_that_its_agent_never_completed_violates_4(run_dir: Path) -> None:
    block = []

    def disown(export: dict) -> None:
        block.append(export["completed"].pop())

    edit(run_dir / "agents" / "2.chain.json", disown)
    (run_dir / "agents" / "2.trace.jsonl").unlink()
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["4"].verdict == "violated"
    assert {finding.block_hash for finding in result.characteristics["4"].evidence} == set(block)


def test_block_of_an_agent_outside_the_roster_violates_4(run_dir: Path) -> None:
    edit(run_dir / "run.json", lambda record: record.update(roster=[1, 2, 3, 4]))
    result = check(gather(RunArchive(run_dir)))
    assert "agent 5, which is not on the roster" in result.characteristics["4"].evidence[0].detail


def test_blocks_of_an_agent_without_records_make_4_not_applicable(perfect: Air, tmp_path: Path) -> None:
    paths = write_exports(perfect, tmp_path, traces=False)
    result = check(gather(RunArchive(*(path for path in paths if path.name != "3.chain.json"))))
    assert result.characteristics["4"].verdict == "not applicable"
    assert "agent 3" in reason(result, "4")


@pytest.mark.parametrize(
    ("trigger", "detail"),
    [
        ({"message": "Commit Block", "from": 1, "seq": 99999}, "never sent"),
        ({"message": "Block Response", "from": 1, "seq": 0}, "which triggers another handler"),
        ({"timer": "voting"}, "which triggers another handler"),
        ({"local": "reconcile_finalize"}, "which did not run before"),
        ({}, "no trigger"),
        ({"boot": 3}, "was triggered by a boot, which only ends a reconcile"),
    ],
)
def test_handler_without_a_valid_trigger_violates_1(run_dir: Path, trigger: dict, detail: str) -> None:
    def forge(lines: list[dict]) -> None:
        next(line for line in lines[1:] if line["handler"] == "receive_commit_block")["trigger"] = trigger

    edit_lines(run_dir / "agents" / "2.trace.jsonl", forge)
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["1"].verdict == "violated"
    assert detail in result.characteristics["1"].evidence[0].detail


def hang(lines: list[dict]) -> None:
    """Remove the ends of all votes from a trace, as if the agent waited forever."""
    lines[:] = [line for line in lines if line.get("handler") != "vote_timer_expiration"]


def test_vote_that_never_ends_violates_1(run_dir: Path) -> None:
    edit_lines(run_dir / "agents" / "2.trace.jsonl", hang)
    result = check(gather(RunArchive(run_dir)))
    assert any("a vote began and did not end" in one.detail for one in result.characteristics["1"].evidence)


def test_killed_run_without_exports_is_judged_by_its_traces(run_dir: Path) -> None:
    for export in (run_dir / "agents").glob("*.chain.json"):
        export.unlink()
    result = check(gather(RunArchive(run_dir)))
    assert verdicts(result) == "hnnnnn"
    edit_lines(run_dir / "agents" / "2.trace.jsonl", hang)
    assert check(gather(RunArchive(run_dir))).characteristics["1"].verdict == "violated"


def test_missing_or_damaged_trace_prevents_a_good_verdict(run_dir: Path) -> None:
    trace = run_dir / "agents" / "2.trace.jsonl"
    lines = trace.read_text().splitlines(keepends=True)
    trace.write_text("".join(lines[:-1]) + "{]\n")
    result = check(gather(RunArchive(run_dir)))
    assert "2.trace.jsonl: line" in result.errors[0]
    assert result.characteristics["1"].verdict != "holds"
    trace.unlink()
    result = check(gather(RunArchive(run_dir)))
    assert result.characteristics["1"].verdict == "not applicable"
    assert "the trace of agent 2 is missing" in reason(result, "1")


def test_incomplete_last_line_of_a_trace_is_no_damage(run_dir: Path) -> None:
    trace = run_dir / "agents" / "2.trace.jsonl"
    trace.write_text(trace.read_text() + '{"t": 1')
    result = check(gather(RunArchive(run_dir)))
    assert verdicts(result) == "hhhhhh"
    assert not result.errors


def test_damaged_record_is_reported_and_exports_are_checked(run_dir: Path) -> None:
    (run_dir / "run.json").write_text('{"schema": "ucp-run/1", "roster": "all", "network": [7]}')
    result = check(gather(RunArchive(run_dir)))
    assert "run.json: `roster` is wrong" in result.errors[0]
    assert verdicts(result)[1:4] == "hhh"


strange = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=5,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_any_content_of_a_run_directory_gets_a_verdict(run_dir: Path, data: st.DataObject) -> None:
    trace, record = run_dir / "agents" / "2.trace.jsonl", run_dir / "run.json"
    kept = trace.read_text(), record.read_text()

    def spoil(document: dict) -> None:
        document[data.draw(st.sampled_from(sorted(document)))] = data.draw(strange)

    try:
        edit_lines(trace, lambda lines: spoil(lines[data.draw(st.integers(0, len(lines) - 1))]))
        edit(record, spoil)
        result = check(gather(RunArchive(run_dir)))
        assert set(verdicts(result)) <= set("hvn")
    finally:
        trace.write_text(kept[0])
        record.write_text(kept[1])


def test_trace_ended_by_a_full_disk_counts_as_incomplete(run_dir: Path) -> None:
    full = {"outcome": "exported", "trace_problem": "No space left on device"}
    edit(run_dir / "run.json", lambda record: record.update(agents={"3": full}))
    result = check(gather(RunArchive(run_dir)))
    assert "3.trace.jsonl: it ends early: No space left on device" in result.errors[0]
    assert result.characteristics["1"].verdict == "not applicable"
