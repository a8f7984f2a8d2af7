"""Test that the texts are in plain English: pattern counts may only decrease, and names and subjects are short."""

import re
import subprocess
from pathlib import Path

import pytest

from tests.prose import COUNTS, EXCEPTIONS, REPOSITORY, counted, files, occurrences, recorded

RATCHET_START = "2026-11-24T15:30:00Z"
"""Commits after this time must have subjects of at most SUBJECT_LENGTH characters."""
SUBJECT_LENGTH = 72
TEST_NAME_LENGTH = 72


def test_no_file_has_more_patterns_than_recorded() -> None:
    allowed = recorded()
    risen = {name: count for name, count in counted().items() if count > allowed.get(name, 0)}
    assert not risen, f"rewrite these texts; `python -m tests.prose {' '.join(risen)}` prints the sentences"


def test_recorded_counts_are_not_higher_than_needed() -> None:
    now = counted()
    fallen = {name: count for name, count in recorded().items() if count > now.get(name, 0)}
    assert not fallen, f"lower {COUNTS.name} with `python -m tests.prose --record`"


def test_each_exception_names_a_file_and_a_reason() -> None:
    assert set(EXCEPTIONS) <= set(files())
    assert all(reason.endswith(".") for reason in EXCEPTIONS.values())


def test_subjects_of_new_commits_have_at_most_72_characters() -> None:
    log = subprocess.run(
        ["git", "-c", "safe.directory=*", "log", f"--since={RATCHET_START}", "--no-merges", "--format=%s"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    if log.returncode:
        pytest.skip("no git history: the subjects of commits cannot be read")
    assert [subject for subject in log.stdout.splitlines() if len(subject) > SUBJECT_LENGTH] == []


def test_names_of_tests_have_at_most_72_characters() -> None:
    sources = [path.read_text() for path in (REPOSITORY / "tests").rglob("*.py")]
    names = [name for source in sources for name in re.findall(r"^\s*(?:async )?def (test_\w+)", source, re.MULTILINE)]
    assert [name for name in names if len(name) > TEST_NAME_LENGTH] == []


@pytest.mark.parametrize(
    ("name", "text", "patterns"),
    [
        ("page.md", "Each agent sends its vote.\n", []),
        ("page.md", "Whoever votes is told.\n", ["who for a program or value", "tell"]),
        ("page.md", "## What is sent\n", ["clause in place of a noun", "inverted start"]),
        ("page.md", "Run `tell` now.\n\n    somebody\n\n```\nnobody\n```\n", []),
        (
            "module.py",
            '"""Of what it has, so many."""\n',
            ["clause in place of a noun", "so many, so often", "inverted start"],
        ),
        ("module.py", "x = 1  # nobody reads it\n", ["nobody, somebody"]),
        ("module.py", 'x = 1\n"""By whom it is set."""\n', ["inverted start"]),
        ("scenario.yaml", "# Vehicles are lost to nobody.\n", ["nobody, somebody"]),
    ],
)
def test_occurrences_are_found_in_prose_and_not_in_code(
    tmp_path: Path, name: str, text: str, patterns: list[str]
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert [occurrence.pattern for occurrence in occurrences(path)] == patterns
