"""Test the page with the results of many agents, and the file with their commands."""

from pathlib import Path

import pytest

from harness.conformance.conformance_page import AgentsFileError, read_agents, to_html
from harness.conformance.results import AlgorithmCounts, CaseResult, ConformanceResults


def test_page_has_a_column_for_each_agent_and_escapes_names() -> None:
    good = ConformanceResults(
        ["ours"],
        3.0,
        "2026-11-22T15:00:00+00:00",
        counted={3: AlgorithmCounts(3, passed=40), 13: AlgorithmCounts(13, passed=7)},
    )
    case = CaseResult(
        "<b>idle</b>; a request", 13, "failed", "receive_request_next_in_sequence", "diverged", "it sent nothing"
    )
    bad = ConformanceResults(
        ["c"], 3.0, "2026-11-22T15:00:00+00:00", [case], {3: AlgorithmCounts(3, passed=39, not_tried=1)}
    )
    page = to_html({"ours": good, "c": bad, "gone": "the agent could not be started"})
    assert '<th scope="col">ours</th><th scope="col">c</th>' in page
    assert "1 failed, 0 passed" in page and "39 passed, 1 not tried" in page and "not tested" in page
    assert "&lt;b&gt;idle" in page and "<b>idle" not in page
    assert "the agent could not be started" in page and "1 failed" in page


@pytest.mark.parametrize("text", ["", "[1]", "ours: python3", "ours: []", "ours: [1]", "a: &a [*a]", "{", "\0"])
def test_wrong_file_of_agents_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "agents.yaml"
    path.write_text(text)
    with pytest.raises(AgentsFileError):
        read_agents(path)


def test_file_of_agents_has_names_and_commands(tmp_path: Path) -> None:
    path = tmp_path / "agents.yaml"
    path.write_text("ours: [python3, -m, ucp.node]\nc: [./ucp_agent]\n")
    assert read_agents(path) == {"ours": ["python3", "-m", "ucp.node"], "c": ["./ucp_agent"]}
