"""Test that the checker compares the log of a shared channel with the traces and run.json."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness import checker
from harness.archive.archive import RunArchive
from harness.checker.records._datagrams_vs_traces import compare_channel
from tests.harness.command import harness

CROWD = """
name: Crowd
agents: 6
duration_s: 120
final_reconcile: true
network: {loss: 0.1, channel: {preset: wifi_1, processing_s: 0}}
"""
Lines = list[dict[str, Any]]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("channel")
    (folder / "crowd.yaml").write_text(CROWD)
    done = harness("run", folder / "crowd.yaml", "--backend", "sim", "--seed", 1, "--out", folder / "run")
    assert (folder / "run" / "run.json").exists(), done.stderr
    return folder / "run"


def details(run: Path, edit: Callable[[Lines], Lines] | None = None) -> list[str]:
    """Return the findings of the check of records after the channel's log is edited."""
    journal = run / "channel.jsonl"
    original = journal.read_text()
    if edit is not None:
        lines = edit([json.loads(line) for line in original.splitlines()])
        journal.write_text("".join(json.dumps(line) + "\n" for line in lines))
    try:
        evidence = checker.gather(RunArchive(run))
        return [contradiction.finding.detail for contradiction in compare_channel(evidence)]
    finally:
        journal.write_text(original)


def test_journal_of_a_run_agrees_with_its_traces(played: Path) -> None:
    assert details(played) == []


def test_handled_message_that_the_channel_lost_contradicts(played: Path) -> None:
    def lose_all(lines: Lines) -> Lines:
        return [{**line, "lost": {"fade": [1]}} if line["sender"] == 2 else line for line in lines]

    found = details(played, lose_all)
    assert any("it handled a message that the channel had lost" in detail for detail in found)
    assert any("different numbers of frames or losses" in detail for detail in found)


def test_handled_message_that_the_channel_never_carried_contradicts(played: Path) -> None:
    found = details(played, lambda lines: lines[: len(lines) // 2])
    assert any("it handled a message that the channel never carried" in detail for detail in found)


def test_count_of_run_json_contradicts_a_shorter_journal(played: Path) -> None:
    assert "different numbers of frames or losses" in details(played, lambda lines: lines[:-1])[0]
