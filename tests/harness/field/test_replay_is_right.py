"""Test that a replay of correct agents never finds a difference: in virtual time, with processes, and in containers.

Test the replay of damaged records: it plays the remaining parts, and missing parts are no deviations.
"""

import base64
import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.field.replay import RecordPlayer, open_record
from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.command import harness, sentences
from tests.harness.field.flights import flown, trace_of
from tests.harness.virtual import scenario

READINGS: list[dict[str, Any]] = [
    {},
    {"vote_names_chain": True},
    {"changed_before_tally": True, "vote_timeout_s": 3},
    {"phase1_tie": "pop", "phase2_tie": "block"},
    {"finalize_gap_s": 0, "max_block_bytes": 400},
]
FAULTS: list[list[dict[str, Any]]] = [
    [],
    [{"at_s": 120, "kill": [1]}],
    [{"at_s": 120, "kill": [1]}, {"at_s": 200, "restart": [1]}],
    [
        {"at_s": 120, "reboot": [1], "down_s": 20, "disk": "kept"},
        {"at_s": 210, "reboot": [2], "down_s": 9, "disk": "lost"},
    ],
    [
        {"at_s": 120, "pause": [1]},
        {"at_s": 190, "resume": [1]},
        {"at_s": 195, "pause": [1]},
        {"at_s": 250, "resume": [1]},
    ],
    [{"at_s": 100, "partition": [[1]]}, {"at_s": 220, "heal": True}],
]


def assert_no_difference(directory: Path) -> None:
    """Replay each record twice: in its run directory, and without the other files. In the second case, the end of the
    agent is unknown.
    """
    traces = sorted((directory / "agents").glob("*.trace.jsonl"))
    assert traces
    for trace in traces:
        if trace.read_bytes().count(b"\n") == 1:
            continue  # It was killed before its first handler run.
        with TemporaryDirectory() as alone:
            (Path(alone) / trace.name).write_bytes(trace.read_bytes())
            for path in (trace, Path(alone) / trace.name):
                record = open_record(path)
                found = RecordPlayer(record).to_end()
                sentences = [deviation.sentence(lambda block: block[:8]) for deviation in found.deviations]
                assert (sentences, found.unjudged, found.steps) == ([], 0, len(record.trace.runs)), path


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    agents=st.integers(2, 7),
    seed=st.integers(0, 2**32 - 1),
    loss=st.sampled_from([0.0, 0.1, 0.25, 0.5]),
    other=st.fixed_dictionaries({"duplicate": st.sampled_from([0.0, 0.3]), "delay": st.sampled_from([0.0, 0.5])}),
    faults=st.sampled_from(FAULTS),
    readings=st.sampled_from(READINGS),
    clocks=st.dictionaries(
        st.integers(1, 2),
        st.fixed_dictionaries({"offset_s": st.floats(-5, 5), "drift": st.floats(-0.02, 0.02)}),
        max_size=2,
    ),
)
def test_replay_finds_no_difference_in_virtual_time(
    agents: int,
    seed: int,
    loss: float,
    other: dict[str, float],
    faults: list[dict[str, Any]],
    readings: dict[str, Any],
    clocks: dict[int, dict[str, float]],
) -> None:
    with TemporaryDirectory() as directory:
        keys = {"timeline": faults, "settings": readings, "clocks": clocks, "final_reconcile": seed % 2 == 0}
        network = {"loss": loss, **other}
        assert_no_difference(flown(Path(directory) / "run", seed, agents=agents, network=network, **keys))


MISSION: dict[str, Any] = {
    "agents": 4,
    "duration_s": 300,
    "speedup": 40,
    "network": {"loss": 0.25},
    "events": {"source": "random", "mean_s": 15},
    "vehicles": {"kind": "none"},
    "timeline": [{"at_s": 100, "pause": [3]}, {"at_s": 200, "resume": [3]}, {"at_s": 150, "kill": [4]}],
}


@pytest.mark.lab
def test_replay_finds_no_difference_with_processes(tmp_path: Path) -> None:
    assert_no_difference(run(scenario(**MISSION), 1, tmp_path / "run", SilentProgress(), "process").directory)


@pytest.mark.docker
def test_replay_finds_no_difference_in_containers(tmp_path: Path) -> None:
    mission = {**MISSION, "docker": {"image_from_host": True}}
    assert_no_difference(run(scenario(**mission), 1, tmp_path / "run", SilentProgress(), "docker").directory)


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("right") / "run", agents=4, duration_s=900)


@pytest.fixture
def traces_only(run_directory: Path, tmp_path: Path) -> Path:
    """Copy the traces of the run, without its other files."""
    directory = tmp_path / "home"
    directory.mkdir()
    for agent in (1, 2, 3, 4):
        shutil.copy(trace_of(run_directory, agent), directory)
    return directory


def change(path: Path, edit: Callable[[list[str]], Any]) -> None:
    lines = path.read_text().splitlines(keepends=True)
    edit(lines)
    path.write_text("".join(lines))


def damage(*numbers: int) -> Callable[[list[str]], None]:
    def edit(lines: list[str]) -> None:
        for number in numbers:
            lines[number] = lines[number][: len(lines[number]) // 2] + "\n"

    return edit


def remove(first: int, last: int) -> Callable[[list[str]], None]:
    def edit(lines: list[str]) -> None:
        del lines[first:last]

    return edit


@pytest.mark.parametrize(
    "edit",
    [
        damage(40),
        damage(30, 31, 32, 60),
        damage(0),
        damage(0, 1),
        damage(1),
        remove(0, 1),
        remove(0, 30),
        remove(40, 60),
    ],
    ids=["a line", "lines", "header", "beginning", "first line", "no header", "no beginning", "lines without a sign"],
)
def test_missing_lines_are_no_difference_and_the_rest_is_played(
    traces_only: Path, edit: Callable[[list[str]], None]
) -> None:
    change(traces_only / "2.trace.jsonl", edit)
    ended = harness("replay", traces_only, "--agent", 2, "--json")
    (document,) = json.loads(ended.stdout)["records"]
    assert (ended.returncode, document["verdict"], document["differences"]) == (0, "as specified", [])
    assert document["steps"] > 30
    assert document["unjudged"] == 0 or document["unjudged_because"]
    sentences(ended.stderr)


def test_difference_after_a_gap_is_found(traces_only: Path) -> None:
    record = open_record(traces_only / "2.trace.jsonl")
    positions = [
        number for number, entry in enumerate(record.entries) if getattr(entry.content, "branch", "") == "approve"
    ]
    line = record.entries[positions[-1]].line

    def disapprove(lines: list[str]) -> None:
        lines[line - 1] = lines[line - 1].replace('"branch":"approve"', '"branch":"disapprove"')
        damage(30)(lines)

    change(traces_only / "2.trace.jsonl", disapprove)
    found = RecordPlayer(open_record(traces_only, 2)).to_end()
    assert found.unjudged and found.lost
    assert [(deviation.line, deviation.handler) for deviation in found.deviations] == [
        (line, "receive_request_add_block")
    ]


def test_compressed_duplicate_and_unrelated_files_change_nothing(traces_only: Path) -> None:
    whole = RecordPlayer(open_record(traces_only, 2)).to_end().steps
    content = (traces_only / "2.trace.jsonl").read_bytes()
    (traces_only / "2.trace.jsonl").unlink()
    (traces_only / "two.gz").write_bytes(gzip.compress(content))
    (traces_only / "copy of two.jsonl").write_bytes(content)
    (traces_only / "holiday.jpg").write_bytes(b"\xff\xd8\xff\xe0 no trace")
    found = RecordPlayer(open_record(traces_only, 2)).to_end()
    assert (found.steps, found.deviations) == (whole, [])
    assert RecordPlayer(open_record(traces_only / "two.gz")).to_end().steps == whole


def test_truncated_record_is_played_up_to_its_end(traces_only: Path) -> None:
    path = traces_only / "2.trace.jsonl"
    path.write_bytes(path.read_bytes()[:20_000])
    ended = harness("replay", path)
    assert ended.returncode == 0
    (said,) = sentences(ended.stderr)
    assert "truncated" in said


def test_unusable_files_give_status_2(tmp_path: Path) -> None:
    (tmp_path / "1.trace.jsonl").write_bytes(bytes(range(256)) * 50)
    for path in (tmp_path, tmp_path / "1.trace.jsonl", tmp_path / "none"):
        ended = harness("replay", path)
        assert ended.returncode == 2
        assert len(sentences(ended.stderr)) == 1


def test_trace_of_version_1_cannot_be_played(traces_only: Path) -> None:
    change(
        traces_only / "2.trace.jsonl",
        lambda lines: lines.__setitem__(0, lines[0].replace("ucp-trace/2", "ucp-trace/1")),
    )
    ended = harness("replay", traces_only / "2.trace.jsonl")
    assert ended.returncode == 2
    assert "lacks received messages" in sentences(ended.stderr)[-1]


def test_unplayable_record_does_not_prevent_the_others(traces_only: Path) -> None:
    change(
        traces_only / "2.trace.jsonl",
        lambda lines: lines.__setitem__(0, lines[0].replace("ucp-trace/2", "ucp-trace/1")),
    )
    ended = harness("replay", traces_only)
    assert ended.returncode == 0
    assert ended.stdout.count("✔ no difference") == 3
    assert any("lacks received messages" in said for said in sentences(ended.stderr))


@pytest.mark.parametrize("by_s", [30.0, -30.0, 5000.0])
def test_changed_clock_causes_no_deviation(by_s: float, traces_only: Path) -> None:
    """The clock of the agent was set during a vote. The timer expires correctly, although the recorded times contradict
    this.
    """
    path = traces_only / "2.trace.jsonl"
    lines = path.read_text().splitlines()
    votes = [number for number, line in enumerate(lines) if '"branch":"proposed"' in line]
    for number in range(votes[len(votes) // 2] + 1, len(lines)):
        entry = json.loads(lines[number])
        entry["t"] = round(entry["t"] + by_s, 6)
        lines[number] = json.dumps(entry, separators=(",", ":"))
    path.write_text("\n".join(lines) + "\n")
    found = RecordPlayer(open_record(traces_only, 2)).to_end()
    assert found.deviations == []
    assert found.unjudged
    assert "clock was set" in found.lost[0]


def test_control_characters_of_a_record_are_not_printed(traces_only: Path) -> None:
    evil = "\x1b]0;title\x07\x1b[2J[bold]"

    def swear(lines: list[str]) -> None:
        entry = json.loads(lines[20])
        entry["branch"], entry["trigger"] = evil, {"message": evil, "from": 1, "seq": 2}
        lines[20] = json.dumps(entry) + "\n"

    change(traces_only / "2.trace.jsonl", swear)
    commands = "goto 21\ns\ncompare\nl\no\n"
    ended = harness("replay", traces_only, "--agent", 2, "--step", input=commands)
    assert ended.returncode == 0, "unknown words of a trace accuse no agent"
    assert "[bold]" in ended.stdout
    assert not any(character in ended.stdout + ended.stderr for character in "\x1b\x07")


def test_irregular_sequence_numbers_are_no_missing_lines(traces_only: Path) -> None:
    path = traces_only / "2.trace.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        for sent in line.get("sent", ()):
            sequence = 2 * sent["seq"]
            datagram = bytearray(base64.b64decode(sent["datagram"]))
            datagram[8:12] = sequence.to_bytes(4, "big")
            sent |= {"seq": sequence, "datagram": base64.b64encode(datagram).decode()}
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = RecordPlayer(open_record(traces_only, 2)).to_end()
    assert found.deviations
    assert found.unjudged == 0
    assert "with sequence number" in found.deviations[0].difference(str)
