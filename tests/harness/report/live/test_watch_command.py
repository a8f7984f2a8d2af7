"""Test the error messages of `ucp-harness watch` and `run --watch`."""

import socket
import sys
from pathlib import Path

import pytest

from harness.errors import MachineError
from harness.report.live.server_process import require_packages
from tests.harness.command import harness, sentences


def test_directory_without_a_run_is_refused(tmp_path: Path) -> None:
    done = harness("watch", tmp_path)
    assert done.returncode == 2
    assert len(sentences(done.stderr)) == 1
    assert "neither a run directory" in done.stderr


def test_used_port_is_reported_before_the_run_begins(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = harness("run", "perfect", "--backend", "sim", "--watch", "--watch-port", port, "--out", tmp_path / "run")
    assert done.returncode == 3
    assert sentences(done.stderr) == [
        f"port {port} of 127.0.0.1 is not available: Address already in use; choose another port, or 0 for a free one"
    ]
    assert not (tmp_path / "run").exists()


def test_missing_package_is_reported_with_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    with pytest.raises(MachineError, match=r"pip install 'ucp-harness\[watch\]'"):
        require_packages()


def test_run_without_open_pages_ends_normally(tmp_path: Path) -> None:
    done = harness("run", "perfect", "--backend", "sim", "--speedup", 1000, "--watch", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "watch it at http://127.0.0.1:" in done.stdout
    assert (tmp_path / "run" / "report.html").is_file()
