"""Test the guided random search.

It finds more than seeds alone, gives the same result on any number of cores, and continues the search of an earlier
night.
"""

import dataclasses
import json
import signal
import subprocess
import sys
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError

from harness.archive.run_record import Cycle
from harness.checker.judgement import Judgement
from harness.errors import RunDirectoryError
from harness.proof.coverage import ReachedStates
from harness.run.simulate import simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.load import find_file
from harness.sweep.explore._scenario_document import document_of, script
from harness.sweep.explore.guided import NightResult, in_words, spend
from harness.sweep.explore.guided._corpus import MOST_BYTES, opened
from harness.sweep.explore.guided._hunt import CandidateRun, Hunt, KeptRun
from harness.sweep.explore.guided._hunt_trial import (
    PlayedRun,
    findings_of,
    identities,
    initial_documents,
    play_trial,
    with_liveness_phase,
    without_liveness_phase,
)
from harness.sweep.explore.guided._mutation import mutate
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences

ORDINARY = {
    "name": "ordinary",
    "agents": 2,
    "duration_s": 60,
    "network": {"loss": 0.2},
    "settings": {"max_block_bytes": 267},
    "events": {"source": "random", "mean_s": 40},
}


def ordinary(**keys: Any) -> Scenario:
    return Scenario.model_validate({**ORDINARY, **keys})


def night(directory: Path, scenario: Scenario | None = None, *, runs: int = 70, jobs: int = 1) -> NightResult:
    return spend(scenario or ordinary(), directory, most_runs=runs, jobs=jobs)


def test_equal_draws_make_equal_changes_and_most_are_playable() -> None:
    limits, initial = initial_documents(ordinary(agents=3), range(2))
    document = initial[0][0]

    def many(seed: int) -> list[Any]:
        rng, last = Random(seed), document
        documents = []
        for _ in range(200):
            last = mutate(document if rng.random() < 0.2 else last, initial[-1][0], limits, rng)
            documents.append(last)
        return documents

    assert many(1) == many(1) != many(2)
    playable = 0
    for each in many(1):
        assert len(each["events"].get("script", [])) <= limits.blocks
        try:
            playable += bool(CandidateRun(each, 1).scenario())
        except ValidationError:
            continue
    assert playable > 100


def test_blocks_are_completed_when_a_timer_ended() -> None:
    limits, ((document, _), *_) = initial_documents(ordinary(agents=3), range(1))

    def lined_up(timers_ended_s: tuple[float, ...]) -> int:
        rng = Random(1)
        documents = [mutate(document, document, limits, rng, timers_ended_s) for _ in range(200)]
        return sum(any(abs(event["at_s"] - 17.123) <= 0.03 for event in script(document)) for document in documents)

    assert lined_up((17.123,)) > 40
    assert lined_up(()) < 5


def test_trial_records_ends_of_timers_and_failed_votes() -> None:
    round_about = play_trial(load_scenario(find_file(Path("refused_by_the_third"))), 1)
    assert 11.0 in round_about.timers_ended_s
    assert round_about.timers_ended_s == tuple(sorted(round_about.timers_ended_s))
    assert len(round_about.failed_votes) == 2
    assert {timer for pattern in round_about.failed_votes for timer in pattern} == {"voting", "phase one", "phase two"}
    at_rest = play_trial(Scenario.model_validate({**ORDINARY, "network": {}}), 1)
    assert (bool(at_rest.timers_ended_s), at_rest.failed_votes) == (True, ())


def test_run_with_a_new_pattern_of_failed_votes_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search keeps the run, although all its agent states are known."""
    limits, ((document, seed), *_) = initial_documents(ordinary(), range(1))
    patterns = iter((("voting", "phase one", "voting"),) * 2 + (("voting", "voting"),))
    monkeypatch.setattr(
        "harness.sweep.explore.guided._hunt.play_trial",
        lambda scenario, seed: PlayedRun(ReachedStates(), (), failed_votes=(next(patterns),)),
    )
    hunt = Hunt(limits, Random(1))
    assert [kept for _, kept in hunt.begin([CandidateRun(document, seed)] * 3, 1)] == [True, False, True]


def test_run_that_needs_more_time_is_counted_and_no_finding(tmp_path: Path) -> None:
    slow = ordinary(network={}, settings={"max_block_bytes": 267, "vote_timeout_s": 100}, settle={"limit_s": 1})
    hunted = night(tmp_path / "corpus", slow, runs=1)
    assert (hunted.hunt.unfinished, hunted.findings, hunted.exit_status) == (1, [], 0)
    assert hunted.to_json()["unfinished"] == 1
    assert "not finished: 1 run needs a higher settle.limit_s to be judged" in in_words(hunted)
    assert "not finished: " in (tmp_path / "corpus" / "report.html").read_text()


def test_documents_near_a_livelock_are_changed_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    limits, ((document, seed), *_) = initial_documents(ordinary(), range(1))
    monkeypatch.setattr(
        "harness.sweep.explore.guided._hunt.play_trial", lambda scenario, seed: PlayedRun(ReachedStates(), ())
    )
    near = KeptRun(CandidateRun(document, seed), new_states=1, steps=100, failed=3, timers_ended_s=())
    others = [dataclasses.replace(near, failed=0) for _ in range(100)]
    hunt = Hunt(limits, Random(1), kept=[near, *others])
    for _ in hunt.round(1):
        pass
    assert near.picked > 5 > max(other.picked for other in others[:50])


def test_livelocks_differ_by_their_cycles_of_timers() -> None:
    def shape(*patterns: str) -> str:
        letters = {"v": "vote", "1": "reconcile_phase_1", "2": "reconcile_phase_2", "f": "finalize"}
        steps = [
            {"agent_id": agent_id, "after_s": float(number), "handler": f"{letters[letter]}_timer_expiration"}
            for agent_id, pattern in enumerate(patterns, 1)
            for number, letter in enumerate(pattern)
        ]
        cycle = Cycle.model_validate(
            {"since_s": 1, "period_s": 20, "agents": [*range(1, len(patterns) + 1)], "steps": steps}
        )
        judgement = Judgement("Liveness", "never finishes", "round in circles")
        result = SimpleNamespace(judgements={"liveness": judgement}, wrong=["liveness"], chains={})
        (identity,) = identities(result, cycle, ordinary())  # type: ignore[arg-type]
        return identity.shape

    assert shape("v12", "12v") == "2 agents going round every 20 s (voting, phase one, phase two)"
    assert shape("2v12v1", "vf12") == shape("v12", "12v"), "the same cycle, played twice and begun elsewhere"
    assert shape("v12", "v1") == shape("1v", "2v1") != shape("v12", "v12")
    assert shape("v12", "v12", "1").startswith("3 agents")


def test_identity_of_a_livelock_does_not_depend_on_the_moment() -> None:
    drawn_in = load_scenario(find_file(Path("drawn_in"))).model_dump(exclude={"expect"}, exclude_unset=True)
    shapes = set()
    for later_s in range(0, 25, 5):
        scenario = Scenario.model_validate({**drawn_in, "duration_s": 106 + later_s})
        shapes |= {identity.shape for identity in findings_of(scenario, 1)}
    (shape,) = shapes
    assert shape.startswith("4 agents going round every 25 s (phase one; ")


def test_liveness_phase_delivers_all_messages() -> None:
    document = document_of(
        ordinary(
            timeline=[{"at_s": 5, "partition": [[1], [2]]}, {"at_s": 20, "loss": 0.9, "for_s": 40}],
            fates=[{"message": "Commit Block", "drop": True}],
        )
    )
    phased = with_liveness_phase(document)
    assert with_liveness_phase(phased) == phased
    assert without_liveness_phase(phased)["timeline"][0] == document["timeline"][0]
    evidence = simulate(Scenario.model_validate(phased), 1, tracing=True).evidence
    assert evidence.connected_since_s == pytest.approx(60, abs=0.01)


def test_hunt_does_not_depend_on_the_number_of_processes() -> None:
    def hunted(jobs: int) -> Hunt:
        limits, initial = initial_documents(ordinary(), range(2))
        hunt = Hunt(limits, Random(1))
        for _ in (*hunt.begin([CandidateRun(*each) for each in initial], jobs), *hunt.round(jobs)):
            pass
        return hunt

    alone, shared = hunted(1), hunted(2)
    assert alone.reached == shared.reached
    assert [kept.candidate for kept in alone.kept] == [kept.candidate for kept in shared.kept]


def test_hunt_finds_new_states_after_its_sets_are_full(monkeypatch: pytest.MonkeyPatch) -> None:
    def hunted() -> Hunt:
        limits, initial = initial_documents(ordinary(), range(2))
        hunt = Hunt(limits, Random(1))
        for _ in (*hunt.begin([CandidateRun(*each) for each in initial], 1), *hunt.round(1)):
            pass
        return hunt

    roomy = hunted()
    for module in ("harness.proof.coverage.reached", "harness.sweep.explore.guided._hunt"):
        monkeypatch.setattr(f"{module}.MOST", 100)
    narrow = hunted()
    assert len(narrow.reached.states) < len(roomy.reached.states)
    assert (narrow.local_states, narrow.pairs) == (roomy.local_states, roomy.pairs)
    assert [kept.candidate for kept in narrow.kept] == [kept.candidate for kept in roomy.kept]


def test_short_night_loses_no_kept_run(tmp_path: Path) -> None:
    night(tmp_path / "corpus")
    kept = {*(tmp_path / "corpus/runs").iterdir()}
    short = night(tmp_path / "corpus", runs=5)
    assert short.hunt.runs < len(kept)
    assert {*(tmp_path / "corpus/runs").iterdir()} == kept, "each once"


def test_kept_runs_are_stored_once_over_several_nights(tmp_path: Path) -> None:
    first = night(tmp_path / "corpus")
    (one, *_) = (tmp_path / "corpus/runs").iterdir()
    one.rename(one.with_name(f"{'0' * 12}-{one.name.partition('-')[2]}"))
    again = night(tmp_path / "corpus", runs=first.hunt.runs)
    files = {path.name for path in (tmp_path / "corpus/runs").iterdir()}
    assert one.name in files
    assert len(files) <= len(again.hunt.kept)


def test_short_document_shows_an_agent_that_is_refused_forever() -> None:
    """A random search found this document: five agents are idle with four chains, and all reject one agent's block."""
    script = [(1.0, 3), (42.944, 2), (48.087, 1), (82.944, 4)]
    document = {
        "name": "c",
        "agents": 5,
        "duration_s": 112.944,
        "settings": {"max_block_bytes": 267},
        "events": {"source": "scripted", "script": [{"at_s": at_s, "agent": agent} for at_s, agent in script]},
        "network": {"loss": 0.5},
        "timeline": [{"at_s": 112.943, "network": {"loss": 0.0}}],
    }
    (finding,) = play_trial(Scenario.model_validate(document), 3).found
    assert str(finding) == "liveness never finishes, 1 agent going round every 20 s (voting, phase one, phase two)"


def test_nights_report_new_ongoing_and_resolved_findings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory, wrong = tmp_path / "corpus", ordinary(quirks={"approve_everything": True})
    first = night(directory, wrong)
    assert {finding.status for finding in first.findings} == {"new"}
    assert first.exit_status == 1
    finding = first.findings[0]
    assert finding.path is not None
    assert finding.finding.identity in findings_of(load_scenario(finding.path), finding.finding.seed)
    assert [*(directory / "runs").iterdir()]
    again = {each.finding.identity: each.status for each in night(directory, wrong, runs=1).findings}
    assert again.keys() == {each.finding.identity for each in first.findings}
    assert {*again.values()} <= {"ongoing", "rare"}
    monkeypatch.setattr(
        "harness.sweep.explore.guided._hunt_trial.identities", lambda *found: ()
    )  # the agents no longer have the error
    mended = night(directory, wrong, runs=1)
    assert {each.status for each in mended.findings} == {"resolved"}
    assert mended.exit_status == 0
    assert "resolved" in (directory / "report.html").read_text()


def test_hostile_files_are_left_out_with_a_sentence(tmp_path: Path) -> None:
    directory = tmp_path / "corpus"
    night(directory, runs=1)
    mark = tmp_path / "started"
    document = document_of(ordinary())
    hostile: dict[str, Any] = {
        "agent_command": ["touch", str(mark)],
        "duration_s": 1e6,
        "agents": 40,
        "quirks": {"approve_everything": True},
        "capture": True,
    }
    for number, (key, value) in enumerate(hostile.items()):
        (directory / "runs" / f"{number:012}-seed-1.yaml").write_text(json.dumps({**document, key: value}))
    (directory / "runs" / "00000000000a-seed-1.yaml").write_text("[" * 100_000)
    (directory / "runs" / "00000000000b-seed-1.yaml").write_text("{" + " " * MOST_BYTES)
    (directory / "runs" / "00000000000c-seed-1.yaml").symlink_to("/dev/zero")
    (directory / "runs" / "mine.txt").write_text("mine")
    (directory / "findings.json").write_text('{"schema": "ucp-findings/2", "findings": [{}]}')
    (directory / "nights" / "20260101T000000Z.json").write_text('{"local_states": 1' + "0" * 400 + "}")
    again = night(directory, runs=1)
    assert len(again.left_out) == len(hostile) + 6, again.left_out
    assert not mark.exists()
    assert (directory / "runs" / "mine.txt").read_text() == "mine"


def test_corpus_accepts_one_scenario_and_one_command(tmp_path: Path) -> None:
    limits, _ = initial_documents(ordinary(), range(1))
    corpus = opened(tmp_path / "corpus", ordinary(), limits)
    with pytest.raises(RunDirectoryError, match="another command works"):
        opened(tmp_path / "corpus", ordinary(), limits)
    corpus.close()
    with pytest.raises(RunDirectoryError, match="of another scenario"):
        opened(tmp_path / "corpus", ordinary(name="other"), limits)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("mine")
    with pytest.raises(RunDirectoryError, match="not a corpus"):
        opened(tmp_path / "mine", ordinary(), limits)


def test_ctrl_c_keeps_findings(tmp_path: Path) -> None:
    path, directory = tmp_path / "wrong.yaml", tmp_path / "corpus"
    path.write_text(json.dumps({**ORDINARY, "quirks": {"approve_everything": True}}))
    command = [*COMMAND, "explore", str(path), "--for", "1h", "--jobs", "1", "--corpus", str(directory), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any(line.startswith("found: ") for line in iter(process.stderr.readline, ""))
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130
    assert "Traceback" not in err
    document = json.loads(out)
    assert document["outcome"] == "interrupted"
    assert document["findings"][0]["status"] == "new"
    assert Path(document["findings"][0]["scenario"]).is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--for", "soon"], "is not a time"),
        (["--runs", "3", "--seeds", "5"], "--seeds and --out do not apply to a hunt"),
        (["--corpus", "there"], "--corpus and --json need a hunt"),
    ],
)
def test_wrong_options_cause_one_sentence(tmp_path: Path, arguments: list[str], said: str) -> None:
    path = tmp_path / "ordinary.yaml"
    path.write_text(json.dumps(ORDINARY))
    done = harness("explore", path, *arguments)
    assert done.returncode == 2
    assert said in " ".join(" ".join(sentences(done.stderr)).replace("│", " ").split())


def test_hunt_plays_foreign_agents(tmp_path: Path) -> None:
    foreign = ordinary(agent_command=[sys.executable, "-m", "ucp.node"])
    result = night(tmp_path / "corpus", foreign, runs=4)
    assert not result.findings
    assert not result.hunt.failed
    assert result.hunt.reached.steps > 0
    assert len(result.hunt.reached.states) > 1
