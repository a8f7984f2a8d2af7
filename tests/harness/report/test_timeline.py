"""Test the timeline of the page: its contents, its size, and the escaping of texts."""

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from harness.archive import archive
from harness.archive.archive import RunArchive
from harness.archive.history import AgentReconcile, AgentVote, BlockCommit, MissionHistory, Phase2Tie, ReconcilePhase
from harness.archive.replication import ReplicationFigures
from harness.play.progress import SilentProgress
from harness.report import _timeline_charts, _timeline_lanes, _timeline_section, write_report
from harness.run.run import run
from tests.harness.play.test_recurrence import in_step
from tests.harness.report.runs import write_run
from tests.harness.report.test_page import HOSTILE, Reader
from tests.harness.virtual import scenario

AGENTS = range(1, 6)
TROUBLED: dict[str, Any] = {
    "agents": 5,
    "duration_s": 1200,
    "network": {"loss": 0.15},
    "timeline": [
        {"at_s": 300, "partition": [[1, 2], [3, 4, 5]]},
        {"at_s": 400, "pause": [5]},
        {"at_s": 450, "resume": [5]},
        {"at_s": 600, "heal": True},
        {"at_s": 700, "kill": [2]},
        {"at_s": 800, "restart": [2]},
        {"at_s": 900, "reboot": [3], "down_s": 30, "disk": "kept"},
    ],
}


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "run"
    return run(scenario(**TROUBLED), 7, directory, SilentProgress(), backend="sim").directory


def html_of(run_dir: Path) -> str:
    return write_report(RunArchive(run_dir)).read_text(encoding="utf-8")


def run_with(tmp_path: Path, *lines: Mapping[str, Any], result: Mapping[str, Any] | None = None) -> Path:
    """Write a run of agents 1 and 2 with these lines in the trace of agent 1."""
    run_dir = write_run(tmp_path / "run", {1: "1.1", 2: "1.1"}, result)
    header = {"schema": "ucp-trace/1", "agent_id": 1, "roster": [1, 2], "settings": {}, "clock": {}}
    written = "".join(json.dumps(line) + "\n" for line in (header, *lines))
    (run_dir / "agents" / "1.trace.jsonl").write_text(written)
    return run_dir


def a_line(at_s: float, handler: str, branch: str, **keys: Any) -> dict[str, Any]:
    state = {"chain": 0, "deque": 0, "stack": 0, "reconciling": False, "idle": True, "top": ""}
    line = {"t": at_s, "handler": handler, "algorithm": 1, "trigger": {"event": 1}, "branch": branch}
    return {**line, "changes": [], "sent": [], "state": state, **keys}


def test_every_kind_of_mark_has_a_title_and_a_legend_entry(troubled: Path) -> None:
    html = html_of(troubled)
    for said in (
        "300\u00a0s to 600\u00a0s: A 3\u20135; B 1, 2",
        "300\u00a0s: partition, loss 15 %, partition 1 2 | 3 4 5",
        "700\u00a0s: kill, agent 2",
        "900\u00a0s: reboot, agent 3, disk kept",
        "agent 5 is paused, 400\u00a0s to 450\u00a0s",
    ):
        assert f"<title>{said}</title>" in html
    for pattern in (
        r"agent 5: vote on 5\.1, [\d.]+\u00a0s to [\d.]+\u00a0s: approved",
        r"agent \d commits 5\.1 \(heard\), [\d.]+\u00a0s",
        r"agent \d: reconcile \(vote not approved\), phase 1, ",
        r"agent \d: reconcile \(chain diverged\), phase 2, ",
        r"from [\d.]+\u00a0s: blocks in chain: longest \d+, mutual \d+",
    ):
        assert re.search(f"<title>{pattern}", html), pattern
    text = Reader(html).text
    for meaning in ("vote approved", "reconcile, phase 3", "lost", "paused", "reboots", "network partitioned"):
        assert meaning in text


def test_tables_have_every_vote_and_reconcile(troubled: Path) -> None:
    page, result = Reader(html_of(troubled)), json.loads((troubled / "run.json").read_text())
    assert f"The {result['figures']['reconciles']} reconciles as a table" in page.text
    assert re.search(
        r"The \d+ votes as a table proposed at agent block outcome took 90\.\d+ s 5 5\.1 approved 10 s", page.text
    )


def test_all_pictures_have_descriptions_and_identifiers_are_unique(troubled: Path) -> None:
    html = html_of(troubled)
    plots = [attributes for _, attributes in Reader(html).elements if attributes.get("class") == "plot"]
    assert len(plots) == 4
    assert all(plot["role"] == "img" and plot["aria-label"] for plot in plots)
    assert "at the end longest" in str(plots[1]["aria-label"])
    identifiers = re.findall(r' id="([^"]+)"', html)
    assert len(identifiers) == len(set(identifiers))


def test_policy_allows_the_one_script_by_its_digest(troubled: Path) -> None:
    html = html_of(troubled)
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = next(str(a["content"]) for tag, a in Reader(html).elements if tag == "meta" and "http-equiv" in a)
    assert f"script-src 'sha256-{digest}';" in policy
    assert "unsafe" not in policy
    assert not [key for _, attributes in Reader(html).elements for key in attributes if key.startswith("on")]


def test_run_without_traces_has_neither_timeline_nor_script(tmp_path: Path) -> None:
    html = html_of(write_run(tmp_path / "run", {1: "1.1"}))
    assert "Timeline" not in html
    assert "<script" not in html
    assert "script-src" not in html


def test_page_of_twenty_minutes_with_all_messages_stays_small(troubled: Path) -> None:
    assert len(html_of(troubled).encode()) < 1_000_000


def test_long_run_with_many_changes_is_thinned_and_reported() -> None:
    phases = [ReconcilePhase("phase 1", 0.0, 1.0, 1)] * 3
    spans = [(agent, float(at_s)) for agent in range(1, 51) for at_s in range(200)]
    votes = [AgentVote(agent, "aa", at_s, at_s + 1, "approved") for agent, at_s in spans]
    reconciles = [AgentReconcile(agent, at_s, at_s + 1, "why", phases, done=True) for agent, at_s in spans]
    commits = [BlockCommit(agent, at_s + part / 4, "aa", "heard") for agent, at_s in spans for part in range(4)]
    ties = [Phase2Tie(agent, at_s, "tie: block") for agent, at_s in spans]
    restless = MissionHistory(votes, reconciles, commits, ties, None)
    picture = _timeline_lanes.draw(restless, [], [], range(1, 51), {}, 200.0, "")
    assert picture.notes == [
        "Of 10000 votes the 6000 longest are drawn",
        "Of 10000 reconciles the 6000 longest are drawn",
        "Each reconcile is drawn as one bar, because there are too many phases",
    ]
    assert [meaning for _, meaning in picture.legend] == ["vote approved", "commit", "reconcile", "tie"]
    voters = {agent for agent in range(1, 51) if f"agent {agent}: vote" in picture.drawing}
    assert voters == set(range(1, 51)), "no agent is left out for another"
    assert len(picture.drawing) < 4_000_000
    groups = _timeline_lanes.group_commits(commits, 200.0)
    assert len(groups) <= _timeline_lanes.MAX_COMMITS
    assert sum(map(len, groups)) == len(commits), "no commit is lost, only drawn together"
    assert all(len({commit.agent for commit in group}) == 1 for group in groups)
    agents = range(_timeline_lanes.MAX_COMMITS + 1)
    many = [BlockCommit(agent, at_s, "a", "vote") for agent in agents for at_s in (1.0, 200.0)]
    assert len(_timeline_lanes.group_commits(many, 200.0)) == len(agents), "one mark for each agent"


def test_charts_are_thinned_but_keep_the_worst_moments() -> None:
    spreads = [ReplicationFigures(float(at_s), 9 - 9 * (at_s == 777), 9, 1, 1, 1.0) for at_s in range(5000)]
    kept = _timeline_charts.thin_states(spreads, 5000.0)
    assert len(kept) <= _timeline_charts.MAX_MOMENTS
    assert spreads[777] in kept
    assert kept[-1] == spreads[-1]
    assert [one.at_s for one in kept] == sorted(one.at_s for one in kept)


@pytest.mark.parametrize(
    ("module", "limit", "said"),
    [(archive, "LARGE_BYTES", "traces are too large"), (_timeline_section, "MAX_ARROWS", "too many for a page")],
)
def test_messages_above_the_limit_are_left_out_with_a_note(
    troubled: Path, monkeypatch: pytest.MonkeyPatch, module: Any, limit: str, said: str
) -> None:
    assert 'data-messages="{&#34;kinds' in html_of(troubled)
    monkeypatch.setattr(module, limit, 10)
    html = html_of(troubled)
    assert 'data-messages="null"' in html
    assert "Messages are not drawn" in html
    assert said in html


def test_hostile_traces_make_no_markup_and_no_large_page(tmp_path: Path) -> None:
    hostile = HOSTILE * 500
    lines = [
        a_line(1.0, "process_next_deque_block", "proposed", sent=[{"message": hostile, "seq": 0, "block": hostile}]),
        a_line(2.0, "vote_timer_expiration", hostile, changes=[["chain+", hostile], ["complete", hostile]]),
        a_line(3.0, "reconcile_begin", "begun", trigger={hostile: hostile}),
        a_line(4.0, "reconcile_phase_1", hostile, trigger={"message": hostile, "from": 1, "seq": 0}),
        a_line(5.0, "reconcile_phase_2_timer_expiration", "tie:" + hostile),
        a_line(1e300, hostile, hostile),
    ]
    faults = [
        {"at_s": 2.0, "what": hostile, "detail": hostile, "agents": [1, 99]},
        {"at_s": 1e300, "what": "kill", "detail": "", "agents": [1]},
        {"at_s": "never"},
    ]
    html = html_of(run_with(tmp_path, *lines, result={"faults": faults}))
    page = Reader(html)
    assert sum(tag == "script" for tag, _ in page.elements) == 1
    assert "img" not in {tag for tag, _ in page.elements}
    assert not [attributes for _, attributes in page.elements if "onerror" in attributes]
    drawn = html[html.index('id="timeline"') : html.index('id="network"')]
    assert len(drawn) < 60_000
    assert "handler runs without a possible time are left out" in page.text


@pytest.mark.parametrize(("outcome", "end_s"), [("completed", 1200.0), ("running", 950.0), ("interrupted", 950.0)])
def test_timeline_of_an_interrupted_run_ends_with_the_run(tmp_path: Path, outcome: str, end_s: float) -> None:
    lines = [a_line(950.0, "build_data_block", "building")]
    html = html_of(run_with(tmp_path, *lines, result={"outcome": outcome}))
    assert f'data-end="{end_s}"' in html


def test_invalid_trace_is_reported_if_there_is_nothing_to_draw(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", {1: "1.1"})
    (run_dir / "agents" / "1.trace.jsonl").write_text("no trace\n")
    html = html_of(run_dir)
    assert "1.trace.jsonl: not a trace; it is left out" in Reader(html).text
    assert "<script" not in html


def test_template_style_and_script_are_in_the_package() -> None:
    shipped = {entry.name for entry in resources.files("harness.report").iterdir()}
    assert {"timeline.html.j2", "timeline.css", "timeline.js"} <= shipped


def test_swarm_in_an_endless_cycle_has_a_bracket_for_each_round(tmp_path: Path) -> None:
    directory = run(in_step(), 1, tmp_path / "run", SilentProgress(), backend="sim").directory
    page = html_of(directory)
    assert page.count('class="round"') == 13, (
        "twelve whole rounds from 11 s to 191 s, and one that the run's end cuts off"
    )
    assert "every 15 s since 11 s" in page
    assert "agent 1, as agents 2, 3, 4 and 5, runs vote_timer_expiration (not approved)" in page
    assert "repeats a cycle" in page


def test_swarm_that_finishes_has_no_brackets(troubled: Path) -> None:
    assert 'class="round"' not in html_of(troubled)


@pytest.mark.parametrize(
    "cycle",
    [
        {"since_s": 1e308, "period_s": 1e-300, "agents": [1]},
        {"since_s": -5, "period_s": -1, "agents": [1]},
        {"since_s": "<script>", "agents": []},
        {"since_s": 0, "agents": []},
        [],
        7,
    ],
)
def test_impossible_cycle_is_drawn_within_the_run(tmp_path: Path, cycle: Any) -> None:
    page = html_of(run_with(tmp_path, a_line(20.0, "build_data_block", "full"), result={"cycle": cycle}))
    assert page.count('class="round"') <= 400
    assert "<script>" not in page.partition("</head>")[2].partition("<script")[0]
