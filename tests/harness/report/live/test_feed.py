"""Test the stream of changes for the live page. Active and finished runs must give the same stream."""

import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

from harness.archive.archive import RunArchive
from harness.archive.history import end_of_traces, history_of
from harness.archive.trace_files import SUFFIX
from harness.archive.traces import Trace
from harness.errors import RunDirectoryError
from harness.report.live import feed as feeds
from harness.report.live._agent_course import KEY_LENGTH, AgentActions, Change
from harness.report.live.feed import ChangeFeed, RunClock
from harness.report.live.server import FAR_BEHIND_BYTES, ChangeLog
from tests.harness.archive.test_history import handler_run, trace_of
from tests.harness.report.live.runs import film, of_kind, played
from ucp.trace import SentMessage
from ucp.trigger import TimerTrigger


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played(tmp_path_factory.mktemp("watched") / "run")


def chains_of(feed_changes: list[Change]) -> dict[int, list[str]]:
    """Return each agent's final chain, computed from the changes."""
    chains: dict[int, list[str]] = {}
    for kind, _, *rest in feed_changes:
        if kind == "z":
            chains[rest[0]] = []
        elif kind == "c":
            for operation, key in rest[1]:
                if operation == "chain+":
                    chains.setdefault(rest[0], []).append(key)
                elif operation == "chain-":
                    assert chains[rest[0]].pop() == key
    return chains


def test_film_ends_with_the_exported_chains(run: Path) -> None:
    feed_changes = film(run)
    exports = RunArchive(run).exports.by_agent
    assert chains_of(feed_changes) == {
        agent: [block.block_hash[:KEY_LENGTH] for block in export.chain] for agent, export in exports.items()
    }
    names = {change[2]: f"{change[3]}.{change[4]}" for change in of_kind("b", feed_changes)}
    assert len(names) == len(set(names.values())) > 5


def test_changes_are_complete_and_in_time_order(run: Path) -> None:
    feed_changes = film(run)
    assert [feed_changes[0][0], feed_changes[-1][0]] == ["run", "end"]
    timed = [change for change in feed_changes if change[0] in ("b", "c", "s", "n", "z", "p")]
    assert [change[1] for change in timed] == sorted(change[1] for change in timed)
    whats = [(change[2], change[5]) for change in of_kind("n", feed_changes) if change[2]]
    assert whats == [("start", ""), ("partition", ""), ("heal", ""), ("kill", "gone"), ("restart", "back")]
    parts = [change[7] for change in of_kind("n", feed_changes) if change[7]]
    assert parts[:3] == [[[1, 2, 3, 4]], [[1, 2], [3, 4]], [[1, 2, 3, 4]]]
    assert [change[2] for change in of_kind("z", feed_changes)] == [4]
    assert feed_changes[-1][1]["outcome"] == "completed"
    assert {judgement[0] for judgement in feed_changes[-1][1]["judgements"]} >= {"1", "2", "3", "4", "5", "6"}


def test_message_change_names_its_receivers(run: Path) -> None:
    feed_changes = film(run)
    sent = sum(len(entry.sent) for trace in RunArchive(run).traces.values() for entry in trace.runs)
    messages = of_kind("m", feed_changes)
    assert len(messages) == sent
    masks = Counter(int(change[5], 16).bit_count() for change in messages)
    assert max(masks) == 3, "nobody hears itself"


def test_changes_do_not_depend_on_the_size_of_reads(run: Path) -> None:
    def facts(feed_changes: list[Change]) -> list[str]:
        return sorted(json.dumps(change) for change in feed_changes if change[0] not in "t")

    assert facts(film(run)) == facts(film(run, 1e7)) == facts(film(run, 3.3))


def test_growing_files_give_the_same_changes(run: Path, tmp_path: Path) -> None:
    """Let each file grow a little at a time. The files end within lines, and restarted agents have separate files."""
    growing = tmp_path / "run"
    (growing / "agents").mkdir(parents=True)
    shutil.copy(run / "run.json", growing)
    sources = [path for path in run.rglob("*.jsonl") if path.is_file()]
    content = {path: path.read_bytes() for path in sources}
    feed = ChangeFeed(growing)
    feed_changes: list[Change] = []
    for share in range(0, 101, 7):
        for path, data in content.items():
            (growing / path.relative_to(run)).write_bytes(data[: len(data) * share // 98])
        feed_changes += feed.poll()[0]
    feed_changes += feed.final_changes()
    feed.close()
    assert chains_of(feed_changes) == chains_of(film(run))
    assert len(of_kind("m", feed_changes)) == len(of_kind("m", film(run)))


def late_film(run: Path, growing: Path, lag: int = 3) -> list[Change]:
    """Return the changes for the page of an active run. In this run, each agent writes its trace later than the agent
    with the next lower ID.
    """
    (growing / "agents").mkdir(parents=True)
    shutil.copy(run / "run.json", growing)
    shutil.copy(run / "network.jsonl", growing)
    content = {path: path.read_bytes().splitlines(keepends=True) for path in run.glob(f"agents/*{SUFFIX}")}
    feed = ChangeFeed(growing)
    feed_changes = [feed.run_change(live=True)]
    for step in range(50):
        for path, lines in content.items():
            share = max(0, step - lag * int(path.name.partition(".")[0]))
            (growing / "agents" / path.name).write_bytes(b"".join(lines[: len(lines) * share // 36]))
        feed_changes += feed.poll()[0]
    feed_changes += feed.final_changes()
    feed.close()
    return feed_changes


def receivers(feed_changes: list[Change]) -> dict[tuple[int, int, float], str]:
    """Return the receivers of each message. The keys are the sender, the sequence number and the time."""
    masks = {}
    for kind, at_s, *rest in feed_changes:
        if kind == "m":
            masks[rest[0], rest[4], at_s] = rest[3]
        elif kind == "h":
            assert (rest[0], rest[2], at_s) in masks
            masks[rest[0], rest[2], at_s] = rest[1]
    return masks


def test_message_gets_the_receivers_that_record_it_late(tmp_path: Path) -> None:
    run = played(tmp_path / "run", timeline=[])
    feed_changes = late_film(run, tmp_path / "live")
    assert of_kind("h", feed_changes)
    assert receivers(feed_changes) == receivers(film(run))


def test_live_feed_reports_messages_while_it_is_behind(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "LINES_AT_ONCE", 5)
    feed, polls, feed_changes = ChangeFeed(run), 0, list[Change]()
    while not of_kind("m", feed_changes):
        changes, more = feed.poll()
        feed_changes, polls = feed_changes + changes, polls + 1
        assert more or of_kind("m", changes), "it has read everything before the first message"
    feed.close()
    assert polls < 10


def test_each_incarnation_of_a_process_is_read_once(run: Path, tmp_path: Path) -> None:
    killed = tmp_path / "run"
    shutil.copytree(run, killed)
    whole = killed / "agents" / f"4{SUFFIX}"
    lines = whole.read_bytes().splitlines(keepends=True)
    again = max(number for number, line in enumerate(lines) if b'"schema"' in line)
    later = killed / "agents" / "4-2"
    later.mkdir()
    (later / whole.name).write_bytes(b"".join(lines[again:]))
    assert chains_of(film(killed)) == chains_of(film(run)), "put together, as at the end of a run"
    whole.write_bytes(b"".join(lines[:again]) + b'{"t":12')
    assert chains_of(film(killed)) == chains_of(film(run)), "and before that"


def test_killed_run_is_shown_up_to_its_end(run: Path, tmp_path: Path) -> None:
    killed = tmp_path / "run"
    shutil.copytree(run, killed)
    record = json.loads((killed / "run.json").read_text())
    for key in ("characteristics", "steps", "records", "liveness", "outcome"):
        del record[key]
    (killed / "run.json").write_text(json.dumps(record))
    (killed / "report.html").unlink()
    trace = killed / "agents" / f"1{SUFFIX}"
    trace.write_bytes(trace.read_bytes()[: trace.stat().st_size // 2])
    feed_changes = film(killed)
    assert feed_changes[-1][1] == {"outcome": "running", "detail": None, "judgements": [], "report": False}
    assert of_kind("note", feed_changes) == []


def test_damage_is_reported_once_and_the_rest_is_shown(run: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "run"
    shutil.copytree(run, damaged)
    with (damaged / "agents" / f"2{SUFFIX}").open("r+b") as file:
        lines = file.read().splitlines(keepends=True)
        file.seek(0)
        file.writelines([*lines[:20], b"{\n", *lines[20:]])
    with (damaged / "network.jsonl").open("ab") as file:
        file.write(b'nonsense\n{"at_s":1,"what":"x","losses":{"1-99":0.5}}\n')
    feed_changes = film(damaged)
    assert sorted(note for _, note in of_kind("note", feed_changes)) == [
        "network.jsonl has damaged lines, which are left out",
        "network.jsonl has unknown lines, which are left out",
        "the trace of agent 2 is damaged, and is read up to the damage",
    ]
    assert len(chains_of(feed_changes)) == 4


def test_duplicate_block_is_reported_at_once(run: Path, tmp_path: Path) -> None:
    wrong = played(tmp_path / "run", timeline=[], quirks={"keep_committed_block": True})
    assert of_kind("x", film(run)) == []
    against = of_kind("x", film(wrong))
    assert against, "some wrong agent of ours is wrong at once"


def test_directory_without_a_run_is_refused_in_one_sentence(
    tmp_path: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path, why in ((tmp_path / "nowhere", "does not exist"), (tmp_path, "neither a run directory")):
        with pytest.raises(RunDirectoryError, match=why):
            ChangeFeed(path)
    monkeypatch.setattr(feeds, "MAX_VEHICLES", 3)
    with pytest.raises(RunDirectoryError, match="at most 3"):
        ChangeFeed(run)


def intervals(feed_changes: list[Change]) -> list[tuple[str, float, float, str]]:
    """Return each finished vote and reconcile with its kind, its start and end, and its result or reason."""
    began: dict[tuple[int, str], tuple[float, str]] = {}
    ended = []
    for _, at_s, agent, doing, more in of_kind("s", feed_changes):
        if doing in ("voting", "reconciling"):
            began[agent, doing] = at_s, more
        elif doing == "voted":
            ended.append(("vote", began.pop((agent, "voting"))[0], at_s, more))
        elif doing == "reconciled":
            start_s, reason = began.pop((agent, "reconciling"))
            ended.append(("reconcile", start_s, at_s, reason))
    return sorted(ended)


def of_report(traces: dict[int, Trace]) -> list[tuple[str, float, float, str]]:
    """Return the same intervals as the report computes them."""
    history = history_of(traces, [], end_of_traces(traces), whole=False)
    votes = [("vote", vote.start_s, vote.end_s, vote.outcome) for vote in history.votes]
    return sorted([*votes, *(("reconcile", one.start_s, one.end_s, one.reason) for one in history.reconciles)])


def reconcile_during_a_vote(directory: Path) -> tuple[list[Change], Trace]:
    """Return the changes and the trace of an agent that begins a reconcile while its vote timer runs."""
    trigger = TimerTrigger("vote_timer_expiration")
    runs = [
        handler_run(1.0, "process_next_deque_block", "proposed", sent=[SentMessage("Block Add Request", 0, "aa")]),
        handler_run(3.0, "reconcile_begin", "begun", trigger=trigger),
        handler_run(3.0, "reconcile_phase_1"),
        handler_run(11.0, "vote_timer_expiration", "approved"),
        handler_run(15.0, "reconcile_finalize", "done"),
    ]
    trace = trace_of(1, runs)
    lines = [trace.header.to_line(), *(run.to_line() for run in runs)]
    (directory / f"1{SUFFIX}").write_text("".join(lines))
    course = AgentActions(directory, 1)
    course.read(100.0, 100)
    course.close()
    return course.changes, trace


def test_feed_and_report_agree_on_a_reconcile_during_a_vote(tmp_path: Path) -> None:
    changes, trace = reconcile_during_a_vote(tmp_path)
    assert intervals(changes) == of_report({1: trace})
    assert intervals(changes) == [("reconcile", 3.0, 15.0, "vote not approved"), ("vote", 1.0, 11.0, "approved")]


def test_slow_reader_of_a_live_run_skips_messages() -> None:
    log = ChangeLog()
    log.append([["c", number, 1, [], "", ""] for number in range(100)])
    log.append([["m", 0.0, 1, "x" * 1000, None, "0"] for _ in range(FAR_BEHIND_BYTES // 1000)])
    log.append([["c", 100, 1, [], "", ""]])

    def read(**how: bool) -> list[str]:
        start, lines = 0, ""
        while start < log.size:
            start, more = log.read(start, **how)
            assert len(more) <= FAR_BEHIND_BYTES
            lines += more
        return [json.loads(line)[0] for line in lines.splitlines()]

    assert Counter(read())["m"] == FAR_BEHIND_BYTES // 1000
    assert Counter(read(may_skip=True))["c"] == 101
    assert Counter(read(may_skip=True))["m"] < 1000
    log.close()


class SetClock(RunClock):
    """A clock that shows the wall time that a test sets."""

    late_s = 0.0

    def wall_s_since(self, mission_s: float) -> float:
        return self.late_s if mission_s < self.now_s else 0.0


def late_run(run: Path, growing: Path, monkeypatch: pytest.MonkeyPatch) -> list[Change]:
    """Return the changes of an active run in which each agent writes later than the agent with the next lower ID.

    The feed is late during two thirds of the run.
    """
    monkeypatch.setattr(feeds, "LINES_AT_ONCE", 3)
    (growing / "agents").mkdir(parents=True)
    shutil.copy(run / "run.json", growing)
    shutil.copy(run / "network.jsonl", growing)
    content = {path: path.read_bytes().splitlines(keepends=True) for path in run.glob(f"agents/*{SUFFIX}")}
    feed, clock = ChangeFeed(growing), SetClock()
    feed_changes = [feed.run_change(live=True)]
    clock.now_s = 1e6
    for step in range(1, 61):
        for path, lines in content.items():
            written = max(0, min(30, step - 3 * int(path.name.partition(".")[0])))
            (growing / "agents" / path.name).write_bytes(b"".join(lines[: len(lines) * written // 30]))
        clock.late_s = 3.4 if step % 12 > 4 else 0.0
        more = True
        while more:
            changes, more = feed.poll_live(clock)
            feed_changes += changes
            if clock.late_s and more:
                break
    feed_changes += feed.final_changes()
    feed.close()
    return feed_changes


def wrongly_lost(
    known: dict[tuple[int, int, float], str], complete: dict[tuple[int, int, float], str], gaps: list[float]
) -> list[tuple[int, int, float]]:
    """Return the messages that the page shows as lost for a receiver that has received them."""
    later, ahead, wrong = 0, sorted(gaps), []
    for message in sorted(known, key=lambda message: -message[2]):
        while ahead and message[2] <= ahead[-1]:
            ahead.pop()
            later = 0
        heard = int(known[message], 16)
        if later & ~heard & int(complete[message], 16):
            wrong.append(message)
        later |= heard
    return wrong


def test_late_feed_leaves_out_messages_and_reports_how_late_it_is(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed_changes, whole = late_run(run, tmp_path / "live", monkeypatch), film(run)
    late = of_kind("late", feed_changes)
    assert late[0] == ["late", 3, True]
    assert late[-1] == ["late", 0, False]
    gaps = [at_s for _, at_s in of_kind("gap", feed_changes)]
    assert gaps
    assert chains_of(feed_changes) == chains_of(whole)
    known, complete = receivers(feed_changes), receivers(whole)
    assert 0.1 < len(known) / len(complete) < 0.95
    assert wrongly_lost(known, complete, gaps) == []
    assert wrongly_lost(known, complete, []) != [], "without its gaps, a page would show losses that are none"
