"""Test report.md: the report is short enough for a pull request, and no text from a run is read as markup."""

import re
from pathlib import Path
from typing import Any

from harness.archive.archive import RunArchive
from harness.report import write_report
from tests.harness.report.runs import write_run


def lines_of(tmp_path: Path, result: dict[str, Any] | None = None) -> list[str]:
    run_dir = write_run(tmp_path / "run", {1: "1.1 2.1", 2: "1.1"}, result)
    for name in ("network.jsonl", "tracks.jsonl", "agents/1.trace.jsonl", "agents/2.trace.jsonl"):
        (run_dir / name).touch()
    write_report(RunArchive(run_dir))
    return (run_dir / "report.md").read_text().splitlines()


def test_summary_of_a_run_fits_about_one_screen(tmp_path: Path) -> None:
    lines = lines_of(tmp_path)
    assert lines[:3] == ["## 15 % loss", "", "**none violated, 4 of 6 hold**"]
    assert "seed 1878470074 \u00b7 backend process \u00b7 engine nftables" in lines[4]
    assert "| 1 | distributed | \u2713 holds | Looked at every export and every trace. |" in lines
    assert "blocks in the mutual chain **39**" in "\n".join(lines)
    assert "- at 300 s vehicle 3 was lost (crash), and with it 1 of 12 completed blocks" in lines
    assert "| 600\u00a0s | heal |  |" in lines
    assert lines[-1] == "<sub>ucp-harness 0.1.0, python 3.11.2, kernel 6.18</sub>"
    assert len(lines) < 40


def test_a_violation_has_its_evidence_below_the_table(tmp_path: Path) -> None:
    evidence = [{"agent_id": 2, "block": "2.1", "block_hash": None, "detail": f"held {count}"} for count in range(9)]
    judged = {"3": {"name": "single copy", "verdict": "violated", "reason": "9 times", "evidence": evidence}}
    lines = lines_of(tmp_path, {"characteristics": judged})
    assert lines[2] == "**1 of 6 characteristics violated**"
    assert "| 3 | single copy | \u2717 violated | 9 times |" in lines
    evidence_lines = [line for line in lines if line.startswith("- characteristic 3")]
    assert evidence_lines[0] == "- characteristic 3, agent 2: held 0"
    assert len(evidence_lines) == 3


def test_summary_of_a_killed_run_names_missing_files(tmp_path: Path) -> None:
    agents = {str(agent): {"outcome": "running"} for agent in (1, 2, 3)}
    lines = lines_of(tmp_path, {"outcome": "running", "characteristics": {}, "figures": {}, "agents": agents})
    assert lines[2] == "**not judged**"
    assert "**The end of this run is not recorded** The run is still active, or it was killed." in lines
    assert "- agent 3: no usable export (running)" in lines
    assert not [line for line in lines if line.startswith("| 1 ")]


def test_hostile_words_make_no_markup_and_no_long_text(tmp_path: Path) -> None:
    hostile = "<img src=x> | [away](javascript:x) **loud** `code`\n\n# title " * 300
    faults = [{"at_s": number, "what": hostile, "detail": hostile} for number in range(500)]
    judged = {"1": {"name": hostile, "verdict": "violated", "reason": hostile, "evidence": [hostile] * 500}}
    changes = {
        "faults": faults,
        "characteristics": judged,
        "figures": {hostile: hostile},
        "versions": {hostile: hostile},
    }
    lines = lines_of(tmp_path, {"scenario": {"name": hostile}, **changes})
    text = "\n".join(lines)
    assert len(text) < 20_000
    markup = re.sub(r"\\.", "", text)
    assert not [word for word in ("<img", "[", "]", "`", "loud**", "# title") if word in markup]
    assert len({line.count(" | ") for line in lines if line.startswith("|")}) == 2, "the rows of two tables"
    assert "488 more are in report.html." in text
