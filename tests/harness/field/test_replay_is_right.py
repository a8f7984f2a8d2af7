"""Test that a replay of correct agents never finds a difference: in virtual time, with processes, and in containers."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.field.replay import RecordPlayer, open_record
from harness.play.progress import SilentProgress
from harness.run.run import run
from tests.harness.field.flights import flown
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
