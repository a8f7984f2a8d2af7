"""Test the page of complete and damaged run directories: the page shows and escapes all their contents."""

import gc
import json
import re
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.archive.archive import RunArchive
from harness.archive.exports import BEFORE_FINAL_RECONCILE
from harness.archive.run_record import AgentRecord, RunRecord
from harness.errors import RunDirectoryError
from harness.report import write_report
from harness.report._swarm_section import counts
from tests.harness.report.runs import exports, result_of, write_exports, write_run

HOSTILE = "</title></style><script>alert(1)</script><img src=x onerror=alert(2)>\"'{{ 7 * 7 }}"
CHAINS = {1: "1.1 2.1 3.1", 2: "1.1 2.1", 3: "1.1 2.1 3.1"}


class Reader(HTMLParser):
    """The elements of a page, and its text as a reader sees it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._in_style = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._in_style = tag == "style"

    def handle_endtag(self, tag: str) -> None:
        self._in_style = False

    def handle_data(self, data: str) -> None:
        if not self._in_style:
            self.words.extend(data.split())

    @property
    def text(self) -> str:
        return " ".join(self.words)


def report(run_dir: Path, result: dict[str, Any] | None = None) -> Reader:
    return Reader(write_report(RunArchive(write_run(run_dir, CHAINS, result))).read_text(encoding="utf-8"))


def test_page_has_its_parts_in_order(tmp_path: Path) -> None:
    page = report(tmp_path / "run")
    headings = [
        "15 % loss",
        "Characteristics",
        "Figures",
        "Survival",
        "Chains",
        "Network and faults",
        "Vehicles and agents",
        "Versions",
    ]
    at = [page.text.rindex(heading) for heading in headings[1:]]
    assert at == sorted(at)
    for said in (
        "none violated, 4 of 6 hold",
        "completed 3 agents 1200 s mission 15 % loss speedup 20 seed 1878470074 backend process engine nftables",
        "61.2 s wall time started 2026-11-21 10:00:00 UTC",
        "1. distributed",
        "not applicable 6. one uniform chain",
        "blocks in the mutual chain 39",
        "longest vote s 12.5",
        "600 s heal",
        "ucp-harness 0.1.0",
    ):
        assert said in page.text


def test_page_lists_the_blocks_lost_with_vehicles(tmp_path: Path) -> None:
    page = report(tmp_path / "run")
    for said in (
        "at 300 s vehicle 3 was lost (crash), and with it 1 of 12 completed blocks",
        "at the end 2 of 41 completed blocks are gone",
        "300 s 3 crash 12 11 1 2",
        "300 s: holders of blocks",
        "3.1 none 1, 2",
    ):
        assert said in page.text
    for survival in (None, 7, {"losses": "none"}):
        assert "Survival" not in report(tmp_path / f"without {survival}", {"survival": survival}).text


def test_violation_comes_first_and_its_evidence_is_complete(tmp_path: Path) -> None:
    result = result_of([1, 2, 3])
    result["characteristics"]["3"] = {
        "name": "single copy",
        "verdict": "violated",
        "reason": "A block is held twice.",
        "evidence": [{"agent_id": 2, "block": "2.1", "block_hash": "ab" * 32, "detail": f"held {n}"} for n in range(9)],
    }
    page = report(tmp_path / "run", result)
    assert "1 of 6 characteristics violated" in page.text
    assert "\u2717 violated 3. single copy" in page.text
    assert "agent 2 block 2.1 hash " + "ab" * 32 in page.text
    assert "6 more" in page.text
    assert all(f"held {n}" in page.text for n in range(9))


def test_page_is_one_file_that_refers_to_no_other(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", CHAINS)
    before = {path.name for path in run_dir.iterdir()}
    html = write_report(RunArchive(run_dir)).read_text(encoding="utf-8")
    assert {path.name for path in run_dir.iterdir()} - before == {"report.html", "report.md", "junit.xml", "chains.svg"}
    page = Reader(html)
    references = {
        value for _, attributes in page.elements for key, value in attributes.items() if key in ("src", "href")
    }
    assert references == {"data:,"}
    assert set(re.findall(r"https?://[^\"' )]*", html)) <= {"http://www.w3.org/2000/svg"}
    assert "@import" not in html
    assert "url(" not in html
    assert "script" not in {tag for tag, _ in page.elements}


def test_security_policy_allows_only_the_style_of_the_page(tmp_path: Path) -> None:
    page = report(tmp_path / "run")
    (policy,) = (a["content"] for tag, a in page.elements if tag == "meta" and a.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'; style-src 'sha256-")
    assert "unsafe" not in policy
    assert not [tag for tag, attributes in page.elements if "style" in attributes or "onclick" in attributes]


def test_hostile_texts_stay_text(tmp_path: Path) -> None:
    result = result_of([1, 2, 3])
    result["scenario"] |= {
        "name": HOSTILE,
        "about": HOSTILE,
        "network": {HOSTILE: HOSTILE, "receivers": {HOSTILE: {HOSTILE: 1}}},
    }
    result["outcome"], result["outcome_detail"] = HOSTILE, HOSTILE
    result["characteristics"] = {
        key: {
            "name": HOSTILE,
            "verdict": HOSTILE,
            "reason": HOSTILE * 9,
            "evidence": [{HOSTILE: HOSTILE}] * 5 + [HOSTILE],
        }
        for key in ("1", HOSTILE)
    }
    result |= dict.fromkeys(("seed", "backend", "engine", "started_at"), HOSTILE)
    result["figures"] = result["versions"] = {HOSTILE: HOSTILE}
    result["agents"] = {"1": {HOSTILE: HOSTILE}, "9": {"outcome": HOSTILE}}
    result["faults"] = [{"at_s": 3, "what": HOSTILE, "detail": HOSTILE, HOSTILE: HOSTILE}, HOSTILE]
    page = report(tmp_path / "run", result)
    assert not {"script", "img"} & {tag for tag, _ in page.elements}
    assert not [attributes for _, attributes in page.elements if "onerror" in attributes]
    assert "<script>alert(1)</script>" in page.text
    assert "{{ 7 * 7 }}" in page.text
    assert "<script" not in (tmp_path / "run" / "chains.svg").read_text(encoding="utf-8")


def test_invalid_character_in_a_name_does_not_stop_the_report(tmp_path: Path) -> None:
    assert "half ?" in report(tmp_path / "run", {"scenario": {"name": "half \ud83d"}}).text


@pytest.mark.parametrize("outcome", ["interrupted", "failed"])
def test_page_of_an_incomplete_run_gives_the_reason(tmp_path: Path, outcome: str) -> None:
    page = report(tmp_path / "run", {"outcome": outcome, "outcome_detail": "agent 3 stopped answering"})
    assert f"This run did not complete: {outcome} agent 3 stopped answering" in page.text
    headline = next(a["class"] for tag, a in page.elements if tag == "p" and "headline" in (a.get("class") or ""))
    assert headline == "headline unknown"


def test_run_file_with_only_its_schema_is_shown(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", CHAINS)
    (run_dir / "run.json").write_text('{"schema": "ucp-run/1"}')
    page = Reader(write_report(RunArchive(run_dir)).read_text(encoding="utf-8"))
    assert "The end of this run is not recorded" in page.text
    assert "No verdict: the run ended" in page.text
    assert "inception block" in page.text


def test_agents_without_usable_export_are_named_and_the_rest_is_drawn(tmp_path: Path) -> None:
    agents = {"2": {"outcome": "crashed", "detail": "exit status 1"}, "4": {"outcome": "hung"}}
    run_dir = write_run(tmp_path / "run", CHAINS, {"agents": agents})
    (run_dir / "agents" / "2.chain.json").write_text('{"schema": "ucp-chain-')
    page = Reader(write_report(RunArchive(run_dir)).read_text(encoding="utf-8"))
    assert "agent 2: no usable export (crashed, exit status 1)" in page.text
    assert "agent 4: no usable export (hung)" in page.text
    assert "agents/2.chain.json: truncated or damaged" in page.text
    assert str(tmp_path) not in page.text
    assert "The 3 blocks in chains as a table" in page.text


def test_page_explains_completed_blocks_that_are_in_no_chain() -> None:
    assert counts(exports({1: "1.1 2.1", 2: "1.1 2.1"}), RunRecord()) is None
    lost = RunRecord(agents={"3": AgentRecord(outcome="killed", completed_before=["a", "b"])})
    assert counts(exports({1: "1.2 2.1"}), lost) == (
        "Of 4 completed blocks 1 is in a chain; 3 are in no available export; "
        "beside these 1 is held without a record of completion."
    )


def test_run_without_any_export_is_still_reported(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", {}, {"scenario": {"name": "all lost", "agents": 2}})
    page = Reader(write_report(RunArchive(run_dir)).read_text(encoding="utf-8"))
    assert "No chains: no agent" in page.text
    assert "agents 1, 2: no usable export" in page.text


def test_complete_chain_has_no_part_to_unfold(tmp_path: Path) -> None:
    page = report(tmp_path / "run")
    assert "input" not in {tag for tag, _ in page.elements}


@pytest.mark.parametrize("content", [None, "", "{", "[]", "{}", '{"schema": "ucp-run/9"}', "[" * 100_000, "\udcff"])
def test_directory_without_readable_result_is_refused_in_one_sentence(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "run.json").write_text(content, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(RunDirectoryError, match=r"^[^\n]*(run\.json: |neither a run directory)[^\n]*$"):
        write_report(RunArchive(tmp_path))


def test_cycle_collector_runs_again_afterwards(tmp_path: Path) -> None:
    report(tmp_path / "run")
    with pytest.raises(RunDirectoryError):
        write_report(RunArchive(tmp_path))
    assert gc.isenabled()


def test_unwritable_report_is_refused_without_temporary_files(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", CHAINS)
    (run_dir / "report.html").mkdir()
    with pytest.raises(RunDirectoryError, match=r"report\.html: cannot be written"):
        write_report(RunArchive(run_dir))
    assert not list(run_dir.glob("*.tmp")) + list(run_dir.glob(".*.tmp"))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(codec=None)),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["at_s", "1", "loss", "x"]), inner),
    max_leaves=6,
)
KEYS = list(result_of([1]))[1:]
SCENARIO_KEYS = list(result_of([1])["scenario"])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from(KEYS), JSON), st.dictionaries(st.sampled_from(SCENARIO_KEYS), JSON))
def test_any_result_gives_a_report(tmp_path: Path, result: dict[str, Any], scenario: dict[str, Any]) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"scenario": scenario, **result, "schema": "ucp-run/1"}))
    assert write_report(RunArchive(tmp_path)).stat().st_size > 0


def test_template_and_styles_are_in_the_package() -> None:
    shipped = {entry.name for entry in resources.files("harness.report").iterdir()}
    assert {"page.html.j2", "page.css", "palette.css", "chain_tree.css", "map.css"} <= shipped


def test_chains_before_and_after_the_final_reconcile_are_drawn(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path, {1: ["1.1", "2.1"], 2: ["1.1", "2.1"]}, result_of([1, 2]))
    write_exports(run_dir / BEFORE_FINAL_RECONCILE, {1: ["1.1", "2.1"], 2: ["1.1"]})
    page = write_report(RunArchive(run_dir)).read_text()
    assert "At the end of the mission" in page
    assert "After the final reconcile" in page
    identifiers = re.findall(r' id="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))


def test_final_reconcile_without_changes_gives_one_tree(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path, {1: ["1.1"], 2: ["1.1"]}, result_of([1, 2]))
    write_exports(run_dir / BEFORE_FINAL_RECONCILE, {1: ["1.1"], 2: ["1.1"]})
    page = write_report(RunArchive(run_dir)).read_text()
    assert "the final reconcile changed nothing" in page
    assert page.count('class="chains"') == 1
