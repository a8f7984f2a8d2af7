"""Test tables for notebooks: one row for each handler run, block, and run of a matrix."""

import sys
from pathlib import Path

import polars
import pytest

from harness.api import (
    MachineError,
    Matrix,
    RunArchive,
    blocks_frame,
    handler_runs_frame,
    load_scenario,
    matrix_frame,
    run,
    run_matrix,
)
from harness.report.export import frames
from harness.scenario.verdict_names import ALL_CHECKS


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> RunArchive:
    directory = tmp_path_factory.mktemp("frames") / "run"
    return RunArchive(run(load_scenario("loss_15"), 7, directory, backend="sim").directory)


def test_table_of_handler_runs_is_complete(archive: RunArchive, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = handler_runs_frame(archive)
    assert whole.height == sum(len(trace.runs) for trace in archive.traces.values())
    first = archive.traces[3].runs[5]
    row = whole.filter(agent=3).row(5, named=True)
    assert (row["t_s"], row["handler"], row["algorithm"], row["branch"]) == (
        first.t,
        first.handler,
        first.algorithm,
        first.branch,
    )
    assert [*zip(row["operations"], row["blocks"], strict=True)] == first.changes
    assert row["sent"] == [sent.message for sent in first.sent]
    assert set(whole["trigger"].unique()) <= {"message", "event", "timer", "local", "operator", "boot"}
    of_messages = whole.filter(polars.col("trigger") == "message")
    assert of_messages["sender"].null_count() == 0
    assert whole["sender"].null_count() == whole.height - of_messages.height
    monkeypatch.setattr(frames, "BATCH", 100)
    assert handler_runs_frame(archive).equals(whole)


def test_table_of_blocks_has_each_holder_of_each_block(archive: RunArchive, tmp_path: Path) -> None:
    table = blocks_frame(archive)
    for agent, export in archive.exports.by_agent.items():
        held = table.filter(holder=agent, place="chain")
        assert held["position"].to_list() == [*range(len(export.chain))]
        assert held["block_hash"].to_list() == list(export.chain_of_block_hashes)
    table.write_parquet(tmp_path / "blocks.parquet")
    assert polars.read_parquet(tmp_path / "blocks.parquet").equals(table)


def test_table_of_a_run_without_blocks_has_the_same_columns(archive: RunArchive, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    empty = blocks_frame(RunArchive(tmp_path))
    assert empty.height == 0
    assert empty.schema == blocks_frame(archive).schema


def test_table_of_a_matrix_has_a_row_for_each_run(tmp_path: Path) -> None:
    keys = {"name": "small", "scenario": {"agents": 2, "duration_s": 60}, "loss": [0, 0.5], "seeds": 2}
    finished = run_matrix(Matrix.model_validate(keys), tmp_path / "out")
    table = matrix_frame(finished)
    assert table.select("loss", "agents", "backend", "seed").rows() == [
        (0.0, 2, "sim", 1),
        (0.0, 2, "sim", 2),
        (0.5, 2, "sim", 1),
        (0.5, 2, "sim", 2),
    ]
    assert table["mutual_chain"].to_list() == [each.figures["mutual_chain"] for each in finished.runs]
    names = [f"characteristic_{key}" if key.isdigit() else key for key in ALL_CHECKS]
    assert table.select(names).row(0) == tuple(finished.runs[0].verdicts[key] for key in ALL_CHECKS)


def test_table_without_polars_names_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "harness.report.export.frames")
    monkeypatch.setitem(sys.modules, "polars", None)
    import harness.api

    with pytest.raises(MachineError, match=r"pip install 'ucp-harness\[data\]'"):
        _ = harness.api.handler_runs_frame
