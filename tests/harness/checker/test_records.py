"""Test the check of records: edited, cut or mixed records never get a good verdict, and unchanged records never
contradict each other.
"""

import base64
import json
import os
import shutil
import socket
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.archive.archive import RunArchive
from harness.checker import Result, check, gather
from harness.play.progress import SilentProgress
from harness.run.run import run
from netem import addresses
from tests.harness.mission import edit, edit_lines
from tests.harness.virtual import scenario
from ucp.block import next_chain_hash

Document = dict[str, Any]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Play a run of three agents with loss, a kill and a restart, a reboot, and a final reconcile."""
    asked = scenario(
        agents=3,
        duration_s=240,
        network={"loss": 0.2},
        events={"source": "random", "mean_s": 5},
        timeline=[
            {"at_s": 60, "reboot": [2], "down_s": 20, "disk": "kept"},
            {"at_s": 120, "kill": [3]},
            {"at_s": 150, "restart": [3]},
        ],
        final_reconcile=True,
    )
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", SilentProgress(), backend="sim").directory


@pytest.fixture
def directory(whole: Path, tmp_path: Path) -> Path:
    shutil.copytree(whole, tmp_path / "run")
    return tmp_path / "run"


def judged(directory: Path) -> Result:
    return check(gather(RunArchive(directory)))


def trace(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.trace.jsonl"


def export(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.chain.json"


def contradicted(result: Result) -> list[str]:
    """Check that the records contradict each other. Return the characteristics that are violated."""
    assert result.beside["records"].verdict == "contradict"
    return [number for number, judgement in result.characteristics.items() if judgement.verdict == "violated"]


def details(result: Result) -> str:
    return "\n".join(finding.detail for finding in result.beside["records"].evidence)


def test_records_of_an_unaltered_run_agree(whole: Path) -> None:
    result = judged(whole)
    assert result.beside["records"].verdict == "agree"
    assert {judgement.verdict for judgement in result.characteristics.values()} == {"holds"}


def recompute_hashes(document: Document) -> None:
    chain_hash = bytes.fromhex(document["inception"]["chain_hash"])
    for block in document["chain"]:
        chain_hash = next_chain_hash(chain_hash, bytes.fromhex(block["block_hash"]))
        block["chain_hash"] = chain_hash.hex()


def reverse(document: Document) -> None:
    document["chain"].reverse()
    recompute_hashes(document)


def test_reversed_chains_with_new_hashes_contradict_the_traces(directory: Path) -> None:
    for agent in (1, 2, 3):
        edit(export(directory, agent), reverse)
    result = judged(directory)
    assert contradicted(result) == ["6"]
    assert "its export differs from its trace: top chain hash" in details(result)


def test_missing_completed_block_is_found(directory: Path) -> None:
    edit(export(directory, 1), lambda document: document["completed"].pop())
    result = judged(directory)
    assert contradicted(result) == ["5"]
    assert "according to its trace, but not according to its export" in details(result)


def test_trace_cut_at_a_line_end_is_found(directory: Path) -> None:
    edit_lines(trace(directory, 1), lambda lines: lines.__delitem__(slice(len(lines) // 2, None)))
    result = judged(directory)
    assert result.beside["records"].verdict == "contradict"
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]
    assert "the agent had counted" in details(result)


def test_trace_without_its_last_line_is_found(directory: Path) -> None:
    edit_lines(trace(directory, 1), lambda lines: lines.pop())
    result = judged(directory)
    assert result.beside["records"].verdict == "contradict"
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]


def test_missing_commit_in_a_trace_is_found(directory: Path) -> None:
    def leave_out(lines: list[Document]) -> None:
        lines.remove(next(line for line in lines[1:] if any(change[0] == "chain+" for change in line["changes"])))

    edit_lines(trace(directory, 1), leave_out)
    assert "3" in contradicted(judged(directory))


def test_wrong_top_chain_hash_violates_4_and_6(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[-1]["state"].update(top="00" * 32))
    result = judged(directory)
    assert {"4", "6"} <= {*contradicted(result)}
    assert "does not match the" in details(result)


def test_clock_that_goes_back_is_found(directory: Path) -> None:
    def jump(lines: list[Document]) -> None:
        for line in lines[len(lines) // 2 :]:
            if "t" in line:
                line["t"] -= 100

    edit_lines(trace(directory, 1), jump)
    assert "the time goes back from" in details(judged(directory))


def test_missing_incarnation_is_found(directory: Path) -> None:
    def leave_out(lines: list[Document]) -> None:
        second = [number for number, line in enumerate(lines) if "schema" in line][1]
        del lines[:second]

    edit_lines(trace(directory, 3), leave_out)
    result = judged(directory)
    assert "its trace has 1 header, but it started 2 times according to run.json" in details(result)
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]


def test_doubled_line_of_a_trace_is_found(directory: Path) -> None:
    def double(lines: list[Document]) -> None:
        quiet = next(number for number, line in enumerate(lines[1:], 1) if not line["changes"] and not line["sent"])
        lines.insert(quiet, lines[quiet])

    edit_lines(trace(directory, 1), double)
    result = judged(directory)
    assert contradicted(result) == ["1"]
    assert "the agent had counted" in details(result)


def test_message_handled_before_it_was_sent_is_found(directory: Path) -> None:
    def early(lines: list[Document]) -> None:
        number = next(number for number, line in enumerate(lines) if "message" in line.get("trigger", {}))
        for line in lines[1 : number + 1]:
            line["t"] = 0.0

    edit_lines(trace(directory, 1), early)
    result = judged(directory)
    assert "1" in contradicted(result)
    assert "before it was sent at" in details(result)


def test_header_without_a_setting_is_found(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[0]["settings"].pop("vote_timeout_s"))
    assert "the header of its trace lacks the setting vote_timeout_s" in details(judged(directory))


def test_differing_settings_are_found(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[0]["settings"].update(vote_timeout_s=11))
    assert "settings.vote_timeout_s" in details(judged(directory))


def test_altered_export_before_the_final_reconcile_is_found(directory: Path) -> None:
    edit(directory / "before_final_reconcile" / "1.chain.json", reverse)
    result = judged(directory)
    assert contradicted(result) == ["6"]
    assert "before the final reconcile" in details(result)


def test_message_handled_with_another_content_is_found(directory: Path) -> None:
    def turn_a_vote(lines: list[Document]) -> None:
        vote = next(line for line in lines[1:] if line.get("trigger", {}).get("message") == "Block Add Response")
        datagram = bytearray(base64.b64decode(vote["input"]))
        datagram[14] ^= 1
        vote["input"] = base64.b64encode(datagram).decode()

    edit_lines(trace(directory, 1), turn_a_vote)
    result = judged(directory)
    assert contradicted(result) == ["1"]
    assert "whose content differs from the sent message" in details(result)


def test_difference_of_run_json_and_network_jsonl_is_found(directory: Path) -> None:
    edit(directory / "run.json", lambda record: record["network"][0].update(fully_connected=True))
    assert "only run.json has: start at 0 s" in details(judged(directory))


def test_missing_fault_is_found(directory: Path) -> None:
    edit(directory / "run.json", lambda record: record["faults"].pop(0))
    assert "only network.jsonl has: reboot at 60 s" in details(judged(directory))


def test_trace_of_another_run_is_found(directory: Path, tmp_path: Path) -> None:
    asked = scenario(agents=3, duration_s=300, events={"source": "random", "mean_s": 5})
    other = run(asked, 4, tmp_path / "other", SilentProgress(), backend="sim").directory
    shutil.copy(trace(other, 2), trace(directory, 2))
    result = judged(directory)
    assert "1" in contradicted(result)
    assert "as the inception block's data, but" in details(result)


def test_appended_trace_of_another_run_is_not_read(directory: Path, tmp_path: Path) -> None:
    asked = scenario(agents=3, duration_s=100)
    other = run(asked, 4, tmp_path / "other", SilentProgress(), backend="sim").directory
    lines = len(trace(directory, 2).read_bytes().splitlines())
    with trace(directory, 2).open("ab") as file:
        file.write(trace(other, 2).read_bytes())
    result = judged(directory)
    (error,) = result.errors
    assert f"line {lines + 1} is the header of another agent, or of another run" in error
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]


@pytest.mark.parametrize(("recorded_us", "verdict"), [(7, "agree"), (8, "contradict")])
def test_clock_of_another_computer_is_compared_with_run_json(directory: Path, recorded_us: int, verdict: str) -> None:
    """The clock of agent 2 shows 7 us at mission second 0. All other clocks show 0 us."""
    edit_lines(
        trace(directory, 2), lambda lines: [line["clock"].update(epoch_us=7) for line in lines if "clock" in line]
    )
    remote = {"2": {"host": "192.168.7.2", "epoch_us": recorded_us, "uncertainty_s": 0.001}}
    edit(directory / "run.json", lambda run: run.update(remote=remote))
    records = judged(directory).judgements["records"]
    assert records.verdict == verdict, records.evidence
    assert verdict == "agree" or "8 for the clock of its computer" in records.evidence[0].detail


@pytest.mark.parametrize("incomplete", [[1], []])
def test_missing_end_of_a_remote_incarnation_accuses_no_agent(directory: Path, incomplete: list[int]) -> None:
    def leave_out_the_end(lines: list[Document]) -> None:
        boot = next(number for number, line in enumerate(lines) if number and "schema" in line)
        del lines[boot - 10 : boot]

    edit_lines(trace(directory, 3), leave_out_the_end)
    remote = {"3": {"host": "192.168.7.2", "epoch_us": 0, "incomplete": incomplete}}
    edit(directory / "run.json", lambda run: run.update(remote=remote))
    result = judged(directory)
    if not incomplete:
        assert result.judgements["records"].verdict == "contradict"
        return
    assert not result.bad, result.judgements[result.bad[0]]
    unknown = {key for key, judgement in result.judgements.items() if judgement.verdict == "not applicable"}
    assert unknown == {*"1235", "steps", "records"}
    assert "the end of incarnation 1 is not on record" in result.judgements["5"].reason


def test_trace_of_a_newer_version_is_an_error(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[0].update(schema="ucp-trace/9"))
    (error,) = judged(directory).errors
    assert "its schema is 'ucp-trace/9', and this version reads 'ucp-trace/1' and 'ucp-trace/2'" in error


def test_trace_of_an_agent_outside_the_roster_is_left_out(directory: Path) -> None:
    shutil.copy(trace(directory, 2), trace(directory, 9))
    edit_lines(trace(directory, 9), lambda lines: [line.update(agent_id=9) for line in lines if "schema" in line])
    (error,) = judged(directory).errors
    assert "its agent is not in this run" in error


@pytest.mark.parametrize("name", ["agents/2.trace.jsonl", "agents/2.chain.json", "before_final_reconcile/2.chain.json"])
def test_file_of_a_gigabyte_is_not_read(directory: Path, name: str) -> None:
    os.truncate(directory / name, 1 << 30)
    tracemalloc.start()
    (error,) = judged(directory).errors
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert f"{name}: " in error
    assert "larger than" in error
    assert peak < 64 << 20


def test_captures_show_messages_that_a_trace_lacks(tmp_path: Path) -> None:
    asked = scenario(agents=3, duration_s=200, capture=True, events={"source": "random", "mean_s": 5})
    directory = run(asked, 1, tmp_path / "run", SilentProgress(), backend="sim").directory
    assert judged(directory).beside["records"].verdict == "agree"
    (directory / "run.json").unlink()  # it also contains the number of sent messages

    def leave_out_a_vote(lines: list[Document]) -> None:
        lines.remove(
            next(line for line in reversed(lines[1:]) if line["trigger"].get("message") == "Block Add Request")
        )

    edit_lines(trace(directory, 1), leave_out_a_vote)
    assert "the capture of its vehicle has a sent message that is missing in its trace" in details(judged(directory))


def test_messages_lost_before_the_lab_are_not_missing_in_a_capture(tmp_path: Path) -> None:
    asked = scenario(agents=3, duration_s=200, capture=True, events={"source": "random", "mean_s": 5})
    directory = run(asked, 1, tmp_path / "run", SilentProgress(), backend="sim").directory
    (capture,) = (directory / "capture").glob("*2*")
    capture.write_bytes(without_packets_of(addresses.address(2), 4, capture.read_bytes()))
    for lost, verdict in ((3, "contradict"), (4, "agree")):
        remote = {"2": {"host": "192.168.7.2", "epoch_us": 0, "lost": lost}}
        edit(directory / "run.json", lambda record, remote=remote: record.update(remote=remote))
        assert judged(directory).beside["records"].verdict == verdict


def without_packets_of(address: str, number: int, content: bytes) -> bytes:
    """Return a capture (pcapng) without the first packets of this sender."""
    kept, position = b"", 0
    while position < len(content):
        (size,) = struct.unpack_from("<I", content, position + 4)
        block = content[position : position + size]
        position += size
        if number and block[0] == 6 and socket.inet_aton(address) == block[28 + 26 : 28 + 30]:
            number -= 1
        else:
            kept += block
    return kept


LISTS = st.sampled_from(["take one out", "double one", "swap two"])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_block_can_be_moved_in_any_record(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Remove, double or swap a block, a line or a change. The run then has a bad verdict or an error."""
    directory = tmp_path_factory.mktemp("edited") / "run"
    shutil.copytree(whole, directory)
    agent = data.draw(st.sampled_from([1, 2, 3]))
    kind = data.draw(st.sampled_from(["export", "before", "trace", "changes"]))
    if kind in ("export", "before"):
        path = (
            export(directory, agent)
            if kind == "export"
            else directory / "before_final_reconcile" / f"{agent}.chain.json"
        )
        document = json.loads(path.read_text())
        place = data.draw(st.sampled_from(["chain", "completed"]))
        document[place] = disorder(data, document[place])
        recompute_hashes(document)
        path.write_text(json.dumps(document))
    else:
        path = trace(directory, agent)
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        if kind == "trace":
            lines = disorder(data, lines)
        else:
            line = data.draw(st.sampled_from([line for line in lines if len(line.get("changes", ())) > 0]))
            line["changes"] = disorder(data, line["changes"])
        path.write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines))
    result = judged(directory)
    assert result.bad or result.errors
    shutil.rmtree(directory.parent)


def disorder(data: st.DataObject, entries: list[Any]) -> list[Any]:
    """Return the entries with one entry removed, one entry doubled, or two different entries swapped."""
    how = data.draw(LISTS)
    number = data.draw(st.integers(0, len(entries) - 1))
    if how == "double one":
        return [*entries[:number], entries[number], *entries[number:]]
    others = [other for other, entry in enumerate(entries) if entry != entries[number]]
    if how == "take one out" or not others:
        return [*entries[:number], *entries[number + 1 :]]
    other = data.draw(st.sampled_from(others))
    swapped = list(entries)
    swapped[number], swapped[other] = entries[other], entries[number]
    return swapped


def test_interrupted_run_has_traces_of_unknown_length(directory: Path) -> None:
    def break_off(document: Document) -> None:
        document.update(outcome="running", agents={})

    edit(directory / "run.json", break_off)
    result = judged(directory)
    assert {key for key, judgement in result.judgements.items() if judgement.kind == "good"} <= {"4", "5", "6"}
    assert "the run did not end normally" in result.beside["records"].reason
    assert "the run did not end normally" in result.beside["steps"].reason


@pytest.mark.parametrize(("runs_later", "agrees"), [(0, False), (1, True)])
def test_report_before_the_last_handler_run_may_differ_from_the_export(
    directory: Path, runs_later: int, agrees: bool
) -> None:
    """Let an agent in real time report that it is not idle, although its later export states that it is idle."""

    def in_real_time(document: list[Document]) -> None:
        for header in document:
            if "schema" in header:
                header["clock"]["epoch_us"] = 1

    for agent in (1, 2, 3):
        edit_lines(trace(directory, agent), in_real_time)
    times_s = [line["t"] for line in lines(trace(directory, 1)) if "handler" in line]
    last_s = times_s[-1 - runs_later]
    report = {"counted": len(times_s) - runs_later, "from_s": last_s, "until_s": last_s}

    def report_busy(document: Document) -> None:
        document["agents"]["1"].update(idle=False, handler_runs=[report])

    edit(directory / "run.json", report_busy)
    assert ("it was not idle at the end" in details(judged(directory))) != agrees


@pytest.mark.parametrize(
    ("passed", "lost", "sentence"),
    [
        (0, 0, None),
        (-1000, 1000, "but the kernel counted 0 messages to its vehicle"),
        (-20, 0, "but the counters of the kernel for its vehicle have"),
    ],
)
def test_counters_of_the_kernel_are_compared_with_traces(
    tmp_path: Path, passed: int, lost: int, sentence: str | None
) -> None:
    asked = scenario(agents=3, duration_s=200, events={"source": "random", "mean_s": 5})
    directory = run(asked, 1, tmp_path / "run", SilentProgress(), backend="sim").directory
    sent = {agent: sum(len(step.get("sent", ())) for step in lines(trace(directory, agent))) for agent in (1, 2, 3)}

    def count(document: Document) -> None:
        """Add the kernel's counters to run.json. The counters of agent 2 differ from the traces by `passed` and
        `lost`.
        """
        others = {agent: sum(sent.values()) - sent[agent] for agent in sent}
        receivers = {str(agent): {"passed": others[agent], "lost": 0, "cut": 0} for agent in sent}
        receivers["2"] |= {"passed": max(0, others[2] + passed), "lost": min(lost, others[2])}
        document.update(engine="nftables", counters={"engine": "nftables", "receivers": receivers})

    edit(directory / "run.json", count)
    result = judged(directory)
    if sentence is None:
        assert result.beside["records"].verdict == "agree"
    else:
        assert sentence in details(result)


def lines(path: Path) -> list[Document]:
    return [json.loads(line) for line in path.read_text().splitlines()]
