"""Test junit.xml of a run: its test cases, and valid XML for any run.

Test report.md: the report is short enough for a pull request, and no text from a run is read as markup.
"""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rich.console import Console

from harness import checker
from harness.archive.archive import RunArchive
from harness.archive.record_file import validate_leniently
from harness.archive.run_record import RunRecord
from harness.checker import Result
from harness.checker.judgement import Judgement
from harness.commands.terminal import show_result
from harness.report import write_report
from harness.report._run_summary import to_junit
from harness.scenario.verdict_names import Verdict
from tests.harness.command import harness
from tests.harness.report.live.runs import film
from tests.harness.report.runs import result_of, write_run

Case = tuple[str, str, str] | None
"""The tag, message and text of the element in a test case. The value is None if the test case passed."""


def suite_of(result: dict[str, Any]) -> ElementTree.Element:
    (suite,) = ElementTree.fromstring(to_junit(validate_leniently(RunRecord, result)[0], {}, {}))  # noqa: S314 - ours
    return suite


def cases(result: dict[str, Any]) -> dict[str, Case]:
    found: dict[str, Case] = {}
    for case in suite_of(result):
        inside = [(one.tag, one.get("message") or "", one.text or "") for one in case]
        assert len(inside) <= 1
        found[case.get("name") or ""] = inside[0] if inside else None
    return found


def judged(number: str, **keys: Any) -> dict[str, Any]:
    """Return a result in which one characteristic has this judgement, and all others hold."""
    result = result_of([1, 2, 3])
    for one in result["characteristics"].values():
        one["verdict"] = "holds"
    result["characteristics"][number] |= keys
    return result


def test_junit_file_has_a_test_case_for_each_characteristic(tmp_path: Path) -> None:
    write_report(RunArchive(write_run(tmp_path / "run", {1: "1.1"})))
    suites = ElementTree.parse(tmp_path / "run" / "junit.xml").getroot()  # noqa: S314 - ours
    (suite,) = suites
    counts = {"tests": "6", "failures": "0", "errors": "0", "time": "61.2"}
    assert dict(suites.attrib) == counts
    named = {"name": "15 % loss", "timestamp": "2026-11-21T10:00:00Z", "skipped": "2"}
    assert dict(suite.attrib) == {**named, **counts}
    assert [case.get("name") for case in suite][::5] == ["1. distributed", "6. one uniform chain"]


def test_violation_is_a_failure_with_its_evidence() -> None:
    evidence = [{"agent_id": 2, "block": "2.1", "block_hash": None, "detail": f"held {count}"} for count in (2, 3)]
    found = cases(judged("3", verdict="violated", reason="2 times: a block is held twice", evidence=evidence))
    said = "violated: 2 times: a block is held twice"
    text = f"{said}\nagent 2, block 2.1: held 2\nagent 2, block 2.1: held 3"
    assert found["3. single copy"] == ("failure", said, text)
    assert [name for name, inside in found.items() if inside] == ["3. single copy"]


def test_not_applicable_characteristic_is_skipped_with_the_reason() -> None:
    found = cases(judged("5", verdict="not applicable", reason="never fully connected"))
    assert found["5. all committed everywhere"] == ("skipped", "not applicable: never fully connected", "")


@pytest.mark.parametrize(
    ("expected", "verdict", "tag"),
    [
        ("violated", "violated", "system-out"),
        ("violated", "holds", "failure"),
        ("holds", "not applicable", "failure"),
        ("not applicable", "not applicable", "system-out"),
    ],
)
def test_expected_verdict_decides_over_success(expected: str, verdict: str, tag: str | None) -> None:
    result = judged("6", verdict=verdict)
    result["scenario"]["expect"] = {"characteristics": {"6": expected}}
    inside = cases(result)["6. one uniform chain"]
    assert (inside and inside[0]) == tag
    assert inside is not None
    assert (
        inside[2].startswith("as expected: ") if tag == "system-out" else inside[2].endswith(f"\nexpected: {expected}")
    )


def violated_as_expected() -> dict[str, Any]:
    result = judged("6", verdict="violated", reason="2 different chains")
    result["scenario"]["expect"] = {"characteristics": {"6": "violated"}}
    return result


def one_judgement(verdict: Verdict) -> Result:
    return Result({"6": Judgement("one uniform chain", verdict, "")}, {})


def test_all_outputs_call_a_violation_expected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "runs" / "run", {1: "1.1", 2: "1.1 2.1"}, violated_as_expected())
    write_report(RunArchive(run))
    note = "<system-out>as expected: violated: 2 different chains</system-out>"
    assert note in (run / "junit.xml").read_text()
    assert 'failures="0"' in (run / "junit.xml").read_text()
    page, summary = (run / "report.html").read_text(), (run / "report.md").read_text()
    for text in (page, summary):
        assert "1 of 6 characteristics violated, as expected" in text
        assert text.count("violated, as expected") == 2
    assert "characteristic 6 violated, as expected" in " ".join(harness("runs", tmp_path / "runs").stdout.split())
    ending = film(run)[-1][1]
    assert ["6", "one uniform chain", "violated, as expected", "2 different chains", "bad"] in ending["judgements"]
    show_result(Console(width=200), one_judgement("violated"), RunArchive(run).record)
    assert "✘ violated, as expected" in capsys.readouterr().out


def test_page_and_terminal_report_unmet_expectations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = result_of([1, 2])
    expect = {"figures": {"distinct_chains": 7}, "characteristics": {"6": "violated"}, "chains": {"2": "00" * 32}}
    result["scenario"]["expect"] = expect
    run = write_run(tmp_path / "run", {1: "1.1", 2: "1.1"}, result)
    write_report(RunArchive(run))
    unmet = "distinct chains is 2, and should be 7"
    assert unmet in (run / "report.html").read_text()
    assert unmet in (run / "report.md").read_text()
    show_result(Console(width=200), checker.check(RunArchive(run)), RunArchive(run).record)
    printed = capsys.readouterr()
    assert unmet in printed.err
    other_chain = "but must end with 000000000000"
    for text in ((run / "report.html").read_text(), (run / "junit.xml").read_text(), printed.err):
        assert other_chain in text
    assert "holds, expected: violated" in printed.out


def test_expected_figures_are_a_test_case() -> None:
    result = result_of([1, 2])
    result["scenario"]["expect"] = {"figures": {"mutual_chain": {"min": 39, "max": None}, "distinct_chains": 2}}
    assert cases(result)["expected figures"] is None
    result["figures"]["distinct_chains"] = 3
    said = "distinct chains is 3, and should be 2"
    assert cases(result)["expected figures"] == ("failure", said, said)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"outcome": "interrupted", "outcome_detail": "at second 7"}, "did not complete: interrupted: at second 7"),
        ({"outcome": "running"}, "The end of this run is not recorded"),
        ({"characteristics": {}}, "No verdict."),
        (
            {"unmatched_fates": ["the first fate never matched"]},
            "the first fate never matched, so this run differs from its script",
        ),
    ],
)
def test_incomplete_run_fails_a_separate_test_case(keys: dict[str, Any], said: str) -> None:
    assert "run" not in cases(result_of([1]))
    inside = cases({**result_of([1]), **keys})["run"]
    assert inside is not None
    assert inside[0] == "failure"
    assert said in inside[1]


def test_any_run_gives_valid_xml() -> None:
    hostile = "]]><failure/>\x00\x1b[31m\ud800\ufffe\x0b&"
    evidence = [{"agent_id": hostile, "detail": hostile, hostile: hostile}, hostile]
    result = judged("3", verdict="violated", name=hostile, reason=hostile, evidence=evidence)
    result |= {"started_at": hostile, "wall_s": -1e300}
    result["scenario"] |= {"name": hostile, "expect": {"figures": hostile}}
    suite = suite_of(result)
    assert suite.get("failures") == "1"
    assert suite.get("name") == "]]><failure/>??[31m???&"
    assert suite.get("time") == "0.0"


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


def test_violation_has_its_evidence_below_the_table(tmp_path: Path) -> None:
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
