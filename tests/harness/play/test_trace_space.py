"""Test traces that end at a quota: the record states how many lines are missing, and the checker does not report that a
property holds.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from harness import cli
from harness.backend_names import BackendName
from harness.play import trace_space
from harness.play.progress import SilentProgress
from harness.play.trace_space import estimated_bytes, space_sentence
from harness.run.run import run
from harness.scenario import Scenario
from tests.harness.command import sentences, write_scenario
from tests.harness.virtual import scenario


def asked(agents: int, **keys: Any) -> Scenario:
    return scenario(agents=agents, duration_s=600, events={"source": "random"}, **keys)


@pytest.mark.parametrize(
    ("agents", "all_delivered", "measured_mb"), [(40, False, 203), (50, True, 9100), (5, False, 0.18)]
)
def test_estimate_is_near_the_size_of_real_traces(agents: int, all_delivered: bool, measured_mb: float) -> None:
    estimated = estimated_bytes(asked(agents), all_delivered=all_delivered)
    assert 0.5 < estimated / 1e6 / measured_mb < 4


def test_run_warns_before_traces_that_exceed_the_quota(tmp_path: Path) -> None:
    assert space_sentence(asked(5), tmp_path, all_delivered=True) == ("", "")
    remark, warning = space_sentence(asked(50, trace_quota_mb=2000), tmp_path, all_delivered=True)
    assert remark == "traces: about 10.2 GB, packed to about 1.7 GB during the run"
    assert warning.startswith("the traces will probably end early, because their quota is 2.0 GB (`trace_quota_mb`)")
    assert space_sentence(asked(50, trace_quota_mb=20_000), tmp_path, all_delivered=True) == (remark, "")


@pytest.mark.parametrize(
    "backend",
    [
        "sim",
        pytest.param("process", marks=pytest.mark.lab),
        pytest.param("docker", marks=pytest.mark.docker),
    ],
)
def test_trace_ends_at_the_quota_and_the_run_is_not_judged(
    backend: BackendName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trace_space, "LEAST_BYTES_PER_AGENT", 1)
    keys: dict[str, Any] = {"vehicles": {"kind": "none"}, "events": {"source": "random", "mean_s": 5}, "speedup": 100}
    keys |= {"docker": {"image_from_host": True}} if backend == "docker" else {}
    small = scenario(agents=3, duration_s=200, trace_quota_mb=0.15, **keys)
    finished = run(small, 1, tmp_path / "run", SilentProgress(), backend)
    for number in (1, 2, 3):
        lines = (finished.directory / "agents" / f"{number}.trace.jsonl").read_bytes()
        assert 40_000 < len(lines) <= 50_000
        assert json.loads(lines.splitlines()[-1])["handler"]
        assert finished.record.agents[str(number)].trace_problem == "File too large"
    assert len(finished.result.errors) == 3
    for error in finished.result.errors:
        assert "it ends early: File too large; " in error
        assert "handler runs after" in error
    verdicts = {key: judgement.verdict for key, judgement in finished.result.judgements.items()}
    assert {verdicts[key] for key in ("1", "2", "3", "steps", "records")} == {"not applicable"}
    assert finished.played.outcome == "completed"


def test_run_names_the_traces_that_end_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trace_space, "LEAST_BYTES_PER_AGENT", 1)
    keys = {"events": {"source": "random", "mean_s": 5}, "vehicles": {"kind": "none"}, "trace_quota_mb": 0.1}
    path, out = write_scenario(tmp_path, **keys), tmp_path / "run"
    monkeypatch.setattr("sys.argv", ["ucp-harness", "run", str(path), "--backend", "sim", "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    before, *_, after = sentences(capsys.readouterr().err)
    assert before.startswith("the traces will probably end early, because their quota is 0 MB")
    assert after.startswith("the traces of agents 1, 2, 3 end early (File too large), so some checks could not judge")
