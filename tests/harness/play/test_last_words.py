"""Who ended with 127: an agent that lacks something, or a shell that did not find a program."""

from pathlib import Path

import pytest

from harness.play.agent_control import CHARACTERS, is_shell_error, last_line_in


@pytest.mark.parametrize(
    "words",
    [
        "./agent: 3: no_such: not found",
        "/opt/my agent/run: 3: exec: no_such: not found",
        "./agent: line 3: no_such: command not found",
        "./agent: line 3: /opt/no_such: No such file or directory",
        "zsh:1: command not found: no_such",
        "/usr/bin/env: \u2018no_such\u2019: No such file or directory",
        "env: no_such: No such file or directory",
        "[FATAL tini (7)] exec /usr/bin/no_such failed: No such file or directory",
    ],
)
def test_a_shell_that_does_not_find_a_program_is_told_from_an_agent(words: str) -> None:
    assert is_shell_error(words)


@pytest.mark.parametrize("words", ["", "telemetry: not found", "feature 'store' not found", "line 3: no store"])
def test_an_agents_own_sentence_is_its_own(words: str) -> None:
    assert not is_shell_error(words)


def test_the_last_line_that_says_something_is_shown_and_is_bounded(tmp_path: Path) -> None:
    log = tmp_path / "7.log"
    assert last_line_in(log) == ""
    log.write_bytes(b"x" * 10000 + b"\nready\n\x1b[31mno\xff store\x1b[0m\r\n \n\x07\n")
    assert last_line_in(log) == "[31mno\ufffd store[0m"
    log.write_bytes(b"x" * 10000)
    assert last_line_in(log) == "x" * CHARACTERS
