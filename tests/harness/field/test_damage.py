"""Test that damaged records of correct agents lead to no false accusation and no traceback."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest

from benchmarks import field_damage
from benchmarks.field_damage import DAMAGES, Undamaged, bring_home, conclude
from harness.archive.archive import RunArchive
from harness.archive.traces import read_trace
from harness.checker import Result, check, gather
from harness.checker.lost_lines import lost_lines, may_be_of_missing_incarnation
from harness.checker.recorded_inputs import decoded
from harness.checker.steps.trace_header import checked
from harness.field.ingest import ingest_files
from harness.field.reconstruct import reconstruct
from harness.field.replay import RecordPlayer, open_record, open_records
from harness.field.replay.field_evidence import field_evidence
from tests.harness.field.flights import flown, trace_of
from tests.harness.virtual import scenario
from ucp.agent import Agent
from ucp.events import LoggableEvent
from ucp.messages import BlockAddResponse
from ucp.trigger import MessageTrigger

FLIGHT: dict[str, Any] = {
    "agents": 3,
    "duration_s": 200,
    "network": {"loss": 0.2},
    "events": {"source": "random", "mean_s": 8},
    "timeline": [{"at_s": 80, "kill": [2]}, {"at_s": 110, "restart": [2]}],
    "capture": True,
}
KINDS = (
    "three lines cut out of each trace",
    "line zeroed",
    "head cut",
    "byte flipped",
    "two lines swapped",
    "lines repeated",
    "disk full in the middle",
    "incarnation missing",
    "exports and captures only",
    "lines of two traces interleaved",
    "clock set back",
)
"""The kinds of damage that this test uses. The benchmark `field_damage` has all kinds."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Undamaged]]:
    kept = tmp_path_factory.mktemp("damage")
    chains = bring_home(scenario(**FLIGHT), 1, "sim", kept / "run", kept / "home")
    yield kept / "home", Undamaged(chains, check(RunArchive(kept / "home")).wrong)


@pytest.mark.parametrize("name", KINDS)
def test_damage_causes_no_accusation(name: str, whole: tuple[Path, Undamaged], tmp_path: Path) -> None:
    home = tmp_path / "home"
    shutil.copytree(whole[0], home)
    DAMAGES[name](home, Random(name))
    concluded = conclude(home, name, whole[1])
    assert concluded.accusations == []
    assert concluded.tracebacks == []


def _lose_incarnation(path: Path, number: int) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    starts = [position for position, line in enumerate(lines) if b'"schema"' in line]
    path.write_bytes(b"".join([*lines[: starts[number]], *lines[[*starts, len(lines)][number + 1] :]]))


def _judge(home: Path) -> Result:
    return check(field_evidence(gather(RunArchive(home)), ingest_files([home]).largest()))


def test_first_incarnation_is_missing_if_others_received_its_messages(
    whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    shutil.copytree(whole[0], tmp_path / "home")
    judged = _judge(tmp_path / "home").judgements
    assert judged["1"].verdict == judged["4"].verdict == "holds"
    _lose_incarnation(tmp_path / "home" / "2.trace.jsonl", 0)
    judged = _judge(tmp_path / "home").judgements
    assert judged["1"].verdict == judged["4"].verdict == judged["steps"].verdict == "not applicable"
    for key in ("1", "4", "steps"):
        assert re.search(
            r"agent 2\b.*it does not have the .* that agent \d received at t=.*, so lines or an incarnation are",
            judged[key].reason,
        ), judged[key].reason


def test_boot_from_disk_proves_an_earlier_incarnation(tmp_path: Path) -> None:
    timeline = [{"at_s": 80, "reboot": [2], "down_s": 10, "disk": "kept"}]
    bring_home(scenario(**FLIGHT | {"timeline": timeline}), 1, "sim", tmp_path / "run", tmp_path / "home")
    _lose_incarnation(tmp_path / "home" / "2.trace.jsonl", 0)
    judged = _judge(tmp_path / "home").judgements
    assert judged["1"].reason.startswith(
        "the trace of agent 2 is incomplete: an incarnation is missing, from whose disk the agent booted at t=90"
    )
    assert judged["4"].verdict in ("not applicable", "holds")


def test_forged_block_during_a_recorded_incarnation_is_not_genuine(
    whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    """The trace of agent 1 covers the time of the block. Therefore no missing part of the trace can have completed the
    block.
    """
    evidence = field_evidence(gather(RunArchive(whole[0])), ingest_files([whole[0]]).largest())
    trace, export = evidence.traces[1], evidence.exports[2]
    held = next(block for block in export.chain if block.agent_id == 1)
    assert may_be_of_missing_incarnation(evidence, held) is False
    later = held.model_copy(update={"timestamp_us": round((trace.runs[-1].t + 1) * 1e6)})
    assert may_be_of_missing_incarnation(evidence, later) is True


def _without(path: Path, *numbers: int) -> Path:
    """Remove the lines with these numbers from a trace, and move the trace away from its run. Line numbers count from
    1.
    """
    lines = path.read_bytes().splitlines(keepends=True)
    moved = path.parent.parent.parent / path.name
    moved.write_bytes(b"".join(line for number, line in enumerate(lines, 1) if number not in numbers))
    return moved


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("damage") / "run")


def test_lost_lines_show_in_sequence_numbers_triggers_and_states(run: Path) -> None:
    trace = read_trace(trace_of(run, 1))
    assert trace is not None
    assert lost_lines(trace) == {}
    reasons = set()
    for position in range(len(trace.runs) - 1):
        kept = trace.runs[:position] + trace.runs[position + 1 :]
        shorter = type(trace)(trace.header, kept)
        reasons |= {why.partition(" (")[2].split()[1] for why in lost_lines(shorter).values()}
    assert reasons == {"line"}


def test_replay_of_trace_without_any_one_line_finds_no_deviation(run: Path) -> None:
    path = trace_of(run, 1)
    lines = len(path.read_bytes().splitlines())
    for number in range(2, min(lines, 60), 3):
        found = RecordPlayer(open_record(_without(path, number))).to_end()
        assert [deviation.sentence(str) for deviation in found.deviations] == [], number


ANSWER, VOTE = "receive_response_next_in_sequence", "receive_vote_add_block"


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the records of five agents that often reconcile."""
    home = tmp_path_factory.mktemp("five") / "home"
    flight = scenario(agents=5, duration_s=300, network={"loss": 0.2}, events={"source": "random", "mean_s": 8})
    bring_home(flight, 1, "sim", home.parent / "run", home)
    return home


@pytest.mark.parametrize(
    "handlers",
    [
        (ANSWER,),
        (ANSWER, ANSWER),
        (ANSWER, ANSWER, ANSWER),
        (VOTE, VOTE),
        ("receive_phase_1_response", "reconcile_phase_1_timer_expiration"),
        ("receive_request_next_in_sequence",),
        ("process_next_deque_block", "build_data_block"),
    ],
)
def test_replay_without_consecutive_lines_finds_no_deviation(handlers: tuple[str, ...], five: Path) -> None:
    tried = 0
    for agent in range(1, 6):
        path = five / f"{agent}.trace.jsonl"
        lines = path.read_bytes().splitlines(keepends=True)
        ran = [json.loads(line).get("handler") for line in lines]
        places = [place for place in range(1, len(lines)) if ran[place : place + len(handlers)] == [*handlers]]
        for place in places[:2]:
            path.write_bytes(b"".join([*lines[:place], *lines[place + len(handlers) :]]))
            found = RecordPlayer(open_record(five, agent)).to_end()
            assert [deviation.sentence(str) for deviation in found.deviations] == [], (agent, place)
            tried += 1
        path.write_bytes(b"".join(lines))
    assert tried


def test_ingest_reads_swapped_and_repeated_lines_once_and_in_order(run: Path, tmp_path: Path) -> None:
    lines = trace_of(run, 1).read_bytes().splitlines(keepends=True)
    (tmp_path / "1.trace.jsonl").write_bytes(b"".join([*lines[:20], *lines[10:20], *lines[20:]]))
    flight = ingest_files([tmp_path]).largest()
    whole = read_trace(trace_of(run, 1))
    assert whole is not None
    assert flight.traces[1].runs == whole.runs


def test_lost_timer_callback_is_named_before_its_effects(run: Path, tmp_path: Path) -> None:
    """The vote timer of an agent stops without a handler run. When the next event occurs, the agent is idle."""
    trace = read_trace(trace_of(run, 1))
    assert trace is not None
    header = checked(trace.header)
    agent = Agent(1, header.roster, header.initial_data, header.settings)
    number = 0
    while agent.state.idle:
        number += 1
        agent.add_event(LoggableEvent(number, 1, bytes(200)), float(number))
    agent.state.voting_timer.stop()
    agent.add_event(LoggableEvent(100, 1, bytes(200)), number + header.settings.vote_timeout_s + 0.5)
    lines = [trace.header.to_line(), *(entry.to_line() for entry in agent.trace())]
    (tmp_path / "1.trace.jsonl").write_text("".join(lines))
    found = RecordPlayer(open_record(tmp_path)).to_end()
    assert found.first is not None
    assert "Algorithm 5, vote_timer_expiration: it did not run, although the voting timer was due at" in (
        found.first.sentence(str)
    )
    assert len(found.deviations) == 1


def test_lost_message_excuses_no_difference_if_records_exclude_it(
    whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    shutil.copytree(whole[0], tmp_path / "home")
    record = open_record(tmp_path / "home", 1)
    received = next(run for run in record.trace.runs if isinstance(run.trigger, MessageTrigger))
    sender, _, message = decoded(received.input)
    unsent = BlockAddResponse(bytes(32), True, None)
    assert record.may_have_arrived(sender, message, received.t)
    assert not record.may_have_arrived(sender, unsent, received.t)
    (tmp_path / "home" / "1.pcapng").unlink()
    without_capture = open_record(tmp_path / "home", 1)
    assert without_capture.may_have_arrived(sender, message, received.t)
    assert not without_capture.may_have_arrived(sender, unsent, received.t)
    (tmp_path / "home" / f"{sender}.trace.jsonl").unlink()
    assert open_record(tmp_path / "home", 1).may_have_arrived(sender, unsent, received.t)


def test_wrong_core_is_named_although_its_trace_has_unknown_parts(tmp_path: Path) -> None:
    """Agent 2 holds one block twice, so its state is unknown. The line with the mistake therefore lies before a gap."""
    wrong = scenario(**FLIGHT, quirks={"commit_others_twice": {"agents": [2]}})
    bring_home(wrong, 1, "sim", tmp_path / "run", tmp_path / "home")
    made = reconstruct(ingest_files([tmp_path / "home"]).largest(), "again")
    assert any("agent 2 behaves as with commit_others_twice" in remark for remark in made.remarks), made.remarks


def test_reconstruct_prints_both_explanations_of_a_doubtful_step(tmp_path: Path) -> None:
    """Without the traces of other agents, a lost vote explains the step as well as the wrong core does."""
    flight = FLIGHT | {"timeline": [], "capture": False, "quirks": {"tie_is_majority": {"agents": [2]}}}
    bring_home(scenario(**flight), 2, "sim", tmp_path / "run", tmp_path / "home")
    for other in (1, 3):
        (tmp_path / "home" / f"{other}.trace.jsonl").unlink()
    made = reconstruct(ingest_files([tmp_path / "home"]).largest(), "again")
    either = next(remark for remark in made.remarks if remark.startswith("either agent 2 behaves as with "))
    assert " tie_is_majority " in either
    assert re.search(r", or before line \d+ perhaps a line is missing \(otherwise: ", either)


def test_damaged_name_of_a_sent_block_is_no_deviation(whole: tuple[Path, Undamaged], tmp_path: Path) -> None:
    """The name of the block is damaged, but the datagram on the same line is intact. Another agent received this
    datagram.
    """
    shutil.copytree(whole[0], tmp_path / "home")
    path = tmp_path / "home" / "1.trace.jsonl"
    header, *lines = path.read_text().splitlines(keepends=True)
    number = next(number for number, line in enumerate(lines) if '"branch":"approve"' in line)
    lines[number] = re.sub(r'("seq":\d+,"block":"[0-9a-f]{20})[0-9a-f]', r"\1&", lines[number])
    path.write_text("".join([header, *lines]))
    found = RecordPlayer(open_record(tmp_path / "home", 1)).to_end()
    assert [deviation.sentence(str) for deviation in found.deviations] == []
    assert "one character of the line is damaged" in found.lost[0]


@pytest.mark.parametrize(
    ("pattern", "damaged"),
    [
        (r'("complete","[0-9a-f]{20})[0-9a-f]', r"\1&"),
        (r'("top":"[0-9a-f]{20})[0-9a-f]{20}', r"\g<1>01234567890123456789"),
    ],
    ids=["completed block", "top chain hash"],
)
def test_damaged_hash_on_one_line_leads_to_no_accusation(
    pattern: str, damaged: str, whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    shutil.copytree(whole[0], tmp_path / "home")
    path = tmp_path / "home" / "1.trace.jsonl"
    header, *lines = path.read_text().splitlines(keepends=True)
    number = next(number for number, line in enumerate(lines) if '"complete"' in line)
    lines[number] = re.sub(pattern, damaged, lines[number])
    path.write_text("".join([header, *lines]))
    assert RecordPlayer(open_record(tmp_path / "home", 1)).to_end().deviations == []
    assert _judge(tmp_path / "home").wrong == ()


@pytest.mark.parametrize(
    ("pattern", "damaged"),
    [
        (r'"block":("[0-9a-f]{64}"),"datagram"', r'"clock":\1,"datagram"'),
        (r'"sent":\[{(.*?)"datagram":"(.{20}).{40}', r'"sent":[{\1"datagram":"\2'),
    ],
)
def test_line_that_contradicts_its_datagram_leads_to_no_accusation(
    pattern: str, damaged: str, whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    """A key or a part of a sent datagram is damaged, and the line can still be parsed.

    The records of the other agents contain the intact datagram.
    """
    home = tmp_path / "home"
    shutil.copytree(whole[0], home)
    path = home / "1.trace.jsonl"
    lines = path.read_text("utf-8").splitlines(keepends=True)
    numbers = [number for number, line in enumerate(lines) if re.search(pattern, line)]
    assert len(numbers) > 5
    for number in numbers[::4]:
        other = re.sub(pattern, damaged, lines[number], count=1)
        path.write_text("".join([*lines[:number], other, *lines[number + 1 :]]), "utf-8")
        found = RecordPlayer(open_record(home, 1)).to_end()
        assert [deviation.sentence(str) for deviation in found.deviations] == [], number


@pytest.mark.parametrize("key", ["algorithm", "trigger", "input"])
def test_two_trace_lines_joined_by_damage_lead_to_no_accusation(
    key: str, whole: tuple[Path, Undamaged], tmp_path: Path
) -> None:
    """A part of the file is lost. The first key after the lost part belongs to a later line, of another handler."""
    home = tmp_path / "home"
    shutil.copytree(whole[0], home)
    path = home / "1.trace.jsonl"
    lines = path.read_text("utf-8").splitlines(keepends=True)
    handlers = [json.loads(line).get("handler") for line in lines]
    joints = [number for number in range(5, len(lines) - 9) if len({None, *handlers[number : number + 4 : 3]}) == 3]
    assert len(joints) > 20
    for number in joints[::7]:
        first, last = (line.partition(f'"{key}":') for line in (lines[number], lines[number + 3]))
        joined = "".join([first[0], *last[1:]])
        path.write_text("".join([*lines[:number], joined, *lines[number + 4 :]]), "utf-8")
        found = RecordPlayer(open_record(home, 1)).to_end()
        assert [deviation.sentence(str) for deviation in found.deviations] == [], number
        assert _judge(home).wrong == (), number


@pytest.mark.parametrize(("seed", "agent_id", "block"), [(4, 2, 3), (9, 2, 16), (11, 3, 12)])
def test_lost_block_of_the_disk_leads_to_no_accusation(seed: int, agent_id: int, block: int, tmp_path: Path) -> None:
    """The line at the lost block is joined from two lines. It has one handler, and the JSON text is valid."""
    home = tmp_path / "home"
    bring_home(scenario(**FLIGHT), seed, "sim", tmp_path / "run", home)
    path = home / f"{agent_id}.trace.jsonl"
    data = path.read_bytes()
    path.write_bytes(data[: block * 4096] + data[(block + 1) * 4096 :])
    found = RecordPlayer(open_record(home, agent_id)).to_end()
    assert [deviation.sentence(str) for deviation in found.deviations] == []
    assert "joined from two lines" in found.lost[0] + found.lost[-1]
    assert _judge(home).wrong == ()


def test_pause_may_begin_soon_after_the_expiry_of_a_timer(whole: tuple[Path, Undamaged]) -> None:
    """An agent can handle a message after the expiry, then pause, and then handle queued messages before the timer."""
    record = open_record(whole[0], 1)
    late_s = record.header.late_s
    record.__dict__["_times"] = [9.0, 10.0 + late_s / 2, 50.0, 50.0 + late_s / 4, 51.0]
    assert record.was_paused(10.0, 50.0)
    assert record.was_paused(10.0, 50.0 + late_s / 4)
    assert not record.was_paused(10.0, 51.0 + late_s)
    record.__dict__["_times"] = [10.0 + step * late_s / 2 for step in range(100)]
    assert not record.was_paused(10.0, 10.0 + 40 * late_s)


@pytest.mark.parametrize("number", [119, 139])
def test_three_lost_lines_near_each_other_lead_to_no_accusation(number: int, tmp_path: Path) -> None:
    """Damage a trace in two ways that a random search found. In flight 119, an event is lost, and no record contains
    the block with this event. In flight 139, three answers within 8 lines are lost.
    """
    flight, home = field_damage.scenario(number, "sim"), tmp_path / "home"
    bring_home(flight, number, "sim", tmp_path / "run", home)
    name = "three lines cut out of each trace"
    DAMAGES[name](home, Random(f"{number} {name}"))
    for record in open_records(home):
        assert [deviation.sentence(str) for deviation in RecordPlayer(record).to_end().deviations] == []


def test_lost_expiry_of_a_vote_during_a_reconcile_leads_to_no_accusation(five: Path, tmp_path: Path) -> None:
    """Algorithm 5 does nothing during a reconcile. The loss of its line shows only at the next vote."""
    home = tmp_path / "home"
    shutil.copytree(five, home)
    removed = 0
    for agent_id in range(1, 6):
        path = home / f"{agent_id}.trace.jsonl"
        lines = path.read_text("utf-8").splitlines(keepends=True)
        idle = [
            number for number, line in enumerate(lines) if '"algorithm":5' in line and '"branch":"reconcile' in line
        ]
        for number in idle[:3]:
            path.write_text("".join([*lines[:number], *lines[number + 1 :]]), "utf-8")
            found = RecordPlayer(open_record(home, agent_id)).to_end()
            assert [deviation.sentence(str) for deviation in found.deviations] == [], (agent_id, number)
        path.write_text("".join(lines), "utf-8")
        removed += len(idle[:3])
    assert removed > 0
