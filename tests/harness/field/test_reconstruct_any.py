"""Test that `reconstruct` reproduces any flight of correct agents with complete records to the last block."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.field.ingest import ingest_files
from harness.field.reconstruct import reconstruct
from tests.harness.field.flights import flown

AGENTS = (1, 2, 3, 4)
DURATION_S = 300


@st.composite
def flights(draw: st.DrawFn) -> dict[str, Any]:
    """Draw a random flight with loss, a partition, a kill or a pause, and inaccurate clocks."""
    struck, at_s = draw(st.sampled_from(AGENTS)), draw(st.integers(60, 120))
    back_s = at_s + draw(st.integers(5, 100))
    death = draw(
        st.sampled_from(
            [
                [],
                [{"at_s": at_s, "kill": [struck]}],
                [{"at_s": at_s, "kill": [struck]}, {"at_s": back_s, "restart": [struck]}],
                [{"at_s": at_s, "reboot": [struck], "down_s": 10, "disk": "kept"}],
                [{"at_s": at_s, "pause": [struck]}, {"at_s": back_s, "resume": [struck]}],
                [{"at_s": at_s, "switch_off": [struck]}],
            ]
        )
    )
    apart = draw(st.sets(st.sampled_from(AGENTS), max_size=3))
    partition = [{"at_s": 30.5, "partition": [sorted(apart)], "for_s": 100}] if apart else []
    clock = st.fixed_dictionaries(
        {"offset_s": st.floats(0, 100), "drift": st.floats(-0.01, 0.01)},
    )
    return {
        "agents": list(AGENTS),
        "duration_s": DURATION_S,
        "network": {"loss": draw(st.sampled_from([0.0, 0.1, 0.4]))},
        "events": {"source": "random", "mean_s": draw(st.sampled_from([3.0, 10.0]))},
        "clocks": draw(st.dictionaries(st.sampled_from(AGENTS), clock)),
        "timeline": [*partition, *death],
        "final_reconcile": draw(st.booleans()),
    }


@settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(flight=flights(), seed=st.integers(0, 1000))
def test_complete_record_is_reproduced(flight: dict[str, Any], seed: int) -> None:
    with TemporaryDirectory() as kept:
        run = flown(Path(kept) / "run", seed, **flight)
        made = reconstruct(ingest_files([run / "agents"]).largest(), "again")
    assert made.problems == []
    assert made.table.contradictions == []
