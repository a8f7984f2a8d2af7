"""Records that were edited, cut, doubled or mixed are never green; those of an honest run never contradict."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.checker import Result, check, gather
from harness.play.progress import Silent
from harness.run.run import run
from tests.harness.virtual import scenario
from ucp.block import next_chain_hash

Document = dict[str, Any]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three agents with loss, one of them shot down and begun anew, one rebooted, and a final reconcile."""
    asked = scenario(
        agents=3,
        duration_s=600,
        network={"loss": 0.2},
        events={"source": "random", "mean_s": 5},
        timeline=[
            {"at_s": 150, "reboot": [2], "down_s": 20, "disk": "kept"},
            {"at_s": 300, "kill": [3]},
            {"at_s": 350, "restart": [3]},
        ],
        final_reconcile=True,
    )
    return run(asked, 3, tmp_path_factory.mktemp("whole") / "run", Silent(), backend="sim").directory


@pytest.fixture
def directory(whole: Path, tmp_path: Path) -> Path:
    shutil.copytree(whole, tmp_path / "run")
    return tmp_path / "run"


def judged(directory: Path) -> Result:
    return check(gather(RunArchive(directory)))


def edit(path: Path, change: Callable[[Document], None]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def edit_lines(path: Path, change: Callable[[list[Document]], Any]) -> None:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    change(lines)
    path.write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines))


def trace(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.trace.jsonl"


def export(directory: Path, agent: int) -> Path:
    return directory / "agents" / f"{agent}.chain.json"


def contradicted(result: Result) -> list[str]:
    """What the records contradict, and which characteristics are violated by it."""
    assert result.beside["records"].verdict == "contradict"
    return [number for number, judgement in result.characteristics.items() if judgement.verdict == "violated"]


def said(result: Result) -> str:
    return "\n".join(finding.detail for finding in result.beside["records"].evidence)


def test_an_honest_run_contradicts_itself_nowhere(whole: Path) -> None:
    result = judged(whole)
    assert result.beside["records"].verdict == "agree"
    assert {judgement.verdict for judgement in result.characteristics.values()} == {"holds"}


def hash_anew(document: Document) -> None:
    chain_hash = bytes.fromhex(document["inception"]["chain_hash"])
    for block in document["chain"]:
        chain_hash = next_chain_hash(chain_hash, bytes.fromhex(block["block_hash"]))
        block["chain_hash"] = chain_hash.hex()


def reverse(document: Document) -> None:
    document["chain"].reverse()
    hash_anew(document)


def test_chains_that_are_all_reversed_and_hashed_anew_are_not_those_of_the_traces(directory: Path) -> None:
    for agent in (1, 2, 3):
        edit(export(directory, agent), reverse)
    result = judged(directory)
    assert contradicted(result) == ["6"]
    assert "its export is not what its trace has led to by then: top chain hash" in said(result)


def test_completed_blocks_that_are_left_out_are_missed(directory: Path) -> None:
    edit(export(directory, 1), lambda document: document["completed"].pop())
    result = judged(directory)
    assert contradicted(result) == ["5"]
    assert "its trace says that it completed block" in said(result)


def test_a_trace_that_was_cut_at_a_line_end_has_not_been_looked_at(directory: Path) -> None:
    edit_lines(trace(directory, 1), lambda lines: lines.__delitem__(slice(len(lines) // 2, None)))
    result = judged(directory)
    assert result.beside["records"].verdict == "contradict"
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]
    assert "it had counted" in said(result)


def test_a_trace_that_lost_its_last_line_has_not_been_looked_at(directory: Path) -> None:
    edit_lines(trace(directory, 1), lambda lines: lines.pop())
    result = judged(directory)
    assert result.beside["records"].verdict == "contradict"
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]


def test_a_commit_that_is_left_out_is_missed(directory: Path) -> None:
    def leave_out(lines: list[Document]) -> None:
        lines.remove(next(line for line in lines[1:] if any(change[0] == "chain+" for change in line["changes"])))

    edit_lines(trace(directory, 1), leave_out)
    assert "3" in contradicted(judged(directory))


def test_a_top_that_is_not_of_the_blocks_below_it_is_not_genuine(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[-1]["state"].update(top="00" * 32))
    result = judged(directory)
    assert {"4", "6"} <= {*contradicted(result)}
    assert "is not that of the" in said(result)


def test_a_clock_that_jumps_back_is_told(directory: Path) -> None:
    def jump(lines: list[Document]) -> None:
        for line in lines[len(lines) // 2 :]:
            if "t" in line:
                line["t"] -= 100

    edit_lines(trace(directory, 1), jump)
    assert "the clock goes from" in said(judged(directory))


def test_a_life_that_is_left_out_is_missed(directory: Path) -> None:
    def leave_out(lines: list[Document]) -> None:
        second = [number for number, line in enumerate(lines) if "schema" in line][1]
        del lines[:second]

    edit_lines(trace(directory, 3), leave_out)
    result = judged(directory)
    assert "its trace has 1 header, and by run.json it began 2 times" in said(result)
    assert not [number for number in "123" if result.characteristics[number].verdict == "holds"]


def test_a_doubled_line_is_one_too_many(directory: Path) -> None:
    def double(lines: list[Document]) -> None:
        quiet = next(number for number, line in enumerate(lines[1:], 1) if not line["changes"] and not line["sent"])
        lines.insert(quiet, lines[quiet])

    edit_lines(trace(directory, 1), double)
    result = judged(directory)
    assert contradicted(result) == ["1"]
    assert "it had counted" in said(result)


def test_a_message_is_not_heard_before_it_is_sent(directory: Path) -> None:
    def early(lines: list[Document]) -> None:
        number = next(number for number, line in enumerate(lines) if "message" in line.get("trigger", {}))
        for line in lines[1 : number + 1]:
            line["t"] = 0.0

    edit_lines(trace(directory, 1), early)
    result = judged(directory)
    assert "1" in contradicted(result)
    assert "which was sent at" in said(result)


def test_settings_are_the_same_for_all(directory: Path) -> None:
    edit_lines(trace(directory, 2), lambda lines: lines[0]["settings"].update(vote_timeout_s=11))
    assert "settings.vote_timeout_s" in said(judged(directory))


def test_the_export_before_the_final_reconcile_is_what_the_trace_had_led_to(directory: Path) -> None:
    edit(directory / "before_final_reconcile" / "1.chain.json", reverse)
    result = judged(directory)
    assert contradicted(result) == ["6"]
    assert "before the final reconcile" in said(result)
