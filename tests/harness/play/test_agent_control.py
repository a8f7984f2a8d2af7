"""Test the error messages about programs that ended with status 127. These are agents without a feature, or shells."""

from pathlib import Path

import pytest

from harness.play.agent_control import MAX_CHARACTERS, is_shell_error, last_line_in


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
def test_message_of_a_shell_is_recognised(words: str) -> None:
    assert is_shell_error(words)


@pytest.mark.parametrize("words", ["", "telemetry: not found", "feature 'store' not found", "line 3: no store"])
def test_message_of_an_agent_is_not_that_of_a_shell(words: str) -> None:
    assert not is_shell_error(words)


def test_last_line_with_text_is_shown_and_bounded(tmp_path: Path) -> None:
    log = tmp_path / "7.log"
    assert last_line_in(log) == ""
    log.write_bytes(b"x" * 10000 + b"\nready\n\x1b[31mno\xff store\x1b[0m\r\n \n\x07\n")
    assert last_line_in(log) == "[31mno\ufffd store[0m"
    log.write_bytes(b"x" * 10000)
    assert last_line_in(log) == "x" * MAX_CHARACTERS
