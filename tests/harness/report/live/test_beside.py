"""Test that a web server which fails, hangs or is slow does not affect the run."""

import sys
from pathlib import Path

import pytest

from harness.errors import MachineError
from harness.play.interventions import Interventions
from harness.report.live import server_process as module
from harness.report.live.server_process import live_page
from harness.scenario import Scenario

HAND = Interventions(Scenario(name="watched"), virtual_time=True)
MUCH = "head -c 300000 /dev/zero | tr '\\0' 'x' >&2; echo >&2"
"""Code that writes more bytes to standard error than a pipe holds."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a program that runs in place of the server. A test writes this program."""
    program = tmp_path / "server"
    program.touch(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    return program


def test_dead_server_with_much_output_is_reported_after_the_run(server: Path, tmp_path: Path) -> None:
    server.write_text(f"#!/bin/sh\n{MUCH}\necho http://here/\n{MUCH}\necho 'no more memory' >&2\nkill -9 $$\n")
    with live_page(tmp_path, 0, HAND) as page:
        assert page.address == "http://here/"
        assert not page.run_is_over()
        assert page.problem == "the server of the page ended by itself with SIGKILL (no more memory); the run continued"


def test_hung_server_ends_with_the_run(server: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LAST_LOOK_S", 0.1)
    monkeypatch.setattr(module, "ENDING_S", 0.1)
    server.write_text("#!/bin/sh\ntrap '' TERM\necho http://here/\nexec sleep 1000\n")
    with live_page(tmp_path, 0, HAND) as page:
        for _ in range(module.MAX_OUTGOING):  # more than a pipe holds
            page._send(["t", 100.0])
        assert not page.run_is_over()
        assert page.problem == "the page hung: its server did not answer within 0.1 s after the run"


def test_server_that_cannot_start_gives_the_reason(server: Path, tmp_path: Path) -> None:
    server.write_text(f"#!/bin/sh\n{MUCH}\necho 'port 80 of 127.0.0.1 cannot be had' >&2\nexit 3\n")
    with pytest.raises(MachineError, match=r"port 80 of 127\.0\.0\.1 cannot be had"), live_page(tmp_path, 0, HAND):
        pass
