"""Test `ucp-harness sitl` with a local server for firmware."""

import json
import os
import platform
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness import forks
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.sitl.firmware_server import BINARY, RELEASE, FirmwareServer, serving

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="installs binaries for x86_64")


@pytest.fixture
def server() -> Iterator[FirmwareServer]:
    with serving() as state:
        yield state


@pytest.fixture
def environ(server: FirmwareServer, tmp_path: Path) -> dict[str, str]:
    """Return environment variables that set an empty cache, and this server as the mirror."""
    python_environment = {name: value for name, value in os.environ.items() if name.startswith(forks.READ_AT_START)}
    cache = str(tmp_path / "cache")
    place = {"XDG_CACHE_HOME": cache, "PATH": "/usr/bin:/bin", "UCP_SITL_URL": server.url, "no_proxy": "127.0.0.1"}
    return {**python_environment, **place}


def test_installed_binary_is_printed_by_path_and_list(environ: dict[str, str], tmp_path: Path) -> None:
    directory = tmp_path / "cache" / "ucp-harness" / "sitl" / "copter" / "4.6.3"
    done = harness("sitl", "install", env=environ)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"copter 4.6.3 is installed: {directory}\n"
    again = harness("sitl", "install", "--version", "4.6.3", env=environ)
    assert (again.returncode, again.stdout) == (0, f"copter 4.6.3 is installed already: {directory}\n")
    path = harness("sitl", "path", env=environ)
    assert (path.returncode, path.stdout) == (0, f"{directory}\n")
    (binary,) = json.loads(harness("sitl", "list", "--json", env=environ).stdout)
    assert binary.pop("fetched_at").endswith("Z")
    assert binary.pop("size_bytes") > len(BINARY)
    assert len(binary.pop("sha256")) == 64
    assert binary == {
        "commit": None,
        "defaults": f"{directory}/copter.parm",
        "vehicle": "copter",
        "source": "cache",
        "path": str(directory),
        "version": "4.6.3",
        "current": True,
        "problem": None,
    }


def test_list_shows_all_sources_and_damaged_binaries(environ: dict[str, str], tmp_path: Path) -> None:
    harness("sitl", "install", env=environ)
    installed = tmp_path / "cache" / "ucp-harness" / "sitl" / "copter" / "4.6.3"
    (installed / "arducopter").write_bytes(b"x")
    named, on_path = tmp_path / "named", tmp_path / "on path"
    for directory, mode in ((named, 0o644), (on_path, 0o755)):
        directory.mkdir()
        (directory / "arducopter").write_bytes(BINARY)
        (directory / "arducopter").chmod(mode)
    environ |= {"ARDUPILOT_SITL": str(named), "PATH": f"{on_path}:{environ['PATH']}"}
    binaries = json.loads(harness("sitl", "list", "--json", env=environ).stdout)
    assert [(binary["source"], binary["path"], binary["problem"]) for binary in binaries] == [
        ("ARDUPILOT_SITL", f"{named}/arducopter", "arducopter is not executable"),
        ("PATH", f"{on_path}/arducopter", None),
        ("cache", str(installed), "arducopter is not the file that was fetched (SHA-256)"),
    ]
    shown = harness("sitl", "list", env=environ).stdout
    assert shown.count("arducopter is not") == 2
    assert "4.6.3" in shown


def test_damaged_binary_has_no_path(environ: dict[str, str], tmp_path: Path) -> None:
    harness("sitl", "install", env=environ)
    (tmp_path / "cache" / "ucp-harness" / "sitl" / "copter" / "4.6.3" / "copter.parm").unlink()
    done = harness("sitl", "path", env=environ)
    assert (done.returncode, done.stdout) == (3, "")
    assert "is damaged, copter.parm cannot be read" in sentences(done.stderr)[0]


def test_missing_binary_has_status_3_and_names_the_command(environ: dict[str, str]) -> None:
    done = harness("sitl", "path", "--vehicle", "plane", env=environ)
    assert (done.returncode, done.stdout) == (3, "")
    assert sentences(done.stderr) == ["no plane is installed: run `ucp-harness sitl install --vehicle plane`"]
    assert "run `ucp-harness sitl install" in harness("sitl", "list", env=environ).stdout
    assert json.loads(harness("sitl", "list", "--json", env=environ).stdout) == []


@pytest.mark.parametrize("options", [("--version", "9.9.9"), ("--vehicle", "boat"), ("--url", "ftp://x")])
def test_wrong_request_has_status_2(options: tuple[str, str], environ: dict[str, str]) -> None:
    done = harness("sitl", "install", *options, env=environ)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_unreachable_server_has_status_3_and_one_sentence(environ: dict[str, str]) -> None:
    environ["UCP_SITL_URL"] = "http://127.0.0.1:1"  # the port of tcpmux, on which no server runs
    done = harness("sitl", "install", env=environ)
    assert done.returncode == 3
    (sentence,) = sentences(done.stderr)
    assert sentence.startswith("127.0.0.1:1 cannot be reached (Connection refused): if there is a mirror")


def test_unwritable_cache_has_status_3(environ: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    done = harness("sitl", "install", env=environ)
    assert done.returncode == 3
    (sentence,) = sentences(done.stderr)
    assert "set XDG_CACHE_HOME" in sentence


def test_interrupted_download_has_status_130_and_continues_later(
    server: FirmwareServer, environ: dict[str, str], tmp_path: Path
) -> None:
    server.change(f"{RELEASE}arducopter", silent_after=len(BINARY) // 2)
    with subprocess.Popen(
        [*COMMAND, "sitl", "install"], env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + DEADLINE_S
        while not (kept := [part for part in tmp_path.glob("**/*.part/*.part") if part.stat().st_size]):
            assert time.monotonic() < deadline and process.poll() is None, "nothing came"
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130
    assert sentences(stderr) == ["interrupted; repeat the command to continue"]
    assert 0 < kept[0].stat().st_size <= len(BINARY) // 2
    server.change(f"{RELEASE}arducopter", silent_after=None)
    assert harness("sitl", "install", env=environ).returncode == 0
    assert server.ranges_of("arducopter")[1] is not None
