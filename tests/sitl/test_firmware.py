"""Test the installation of ArduPilot's binaries from a local server that works correctly, or fails in various ways."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import platform
import stat
import threading
import urllib.request
from collections.abc import Iterator
from email.message import Message
from pathlib import Path

import pytest

from sitl.ardupilot import ArduPilot
from sitl.download import DownloadError, HttpsRedirectHandler, NotThereError, UnreachableError, download, fetch_text
from sitl.firmware import CacheError, InstallOutcome, RequestError, install
from sitl.installed import InstalledVersion, all_installed, cache, current
from sitl.setup import VehicleSetup
from sitl.vehicle import NoBinaryError, UnusableBinaryError, VehicleError
from tests.sitl.firmware_server import (
    BINARY,
    COMMIT,
    PARAMETERS,
    RELEASE,
    FirmwareServer,
    Resource,
    git_version,
    serving,
)

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="installs binaries for x86_64")

BINARY_PATH = f"{RELEASE}arducopter"
PARAMETERS_PATH = f"/ArduPilot/ardupilot/{COMMIT}/Tools/autotest/default_params/copter.parm"
HALF = len(BINARY) // 2


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")


@pytest.fixture
def server() -> Iterator[FirmwareServer]:
    with serving() as state:
        yield state


class Onlooker:
    """An observer of a download. It records its calls, and can end the download like Ctrl-C or a full disk."""

    def __init__(self, end: BaseException | None = None) -> None:
        self.waited = threading.Event()
        self.seen: list[tuple[int, int]] = []
        self._end = end

    def waits(self) -> None:
        self.waited.set()

    def downloads(self, done: int, total: int) -> None:
        self.seen.append((done, total))
        if self._end:
            raise self._end


ARM_BINARY = b"\x7fELF\x01\x01\x01" + bytes(9) + b"\x02\x00\x28\x00" + BINARY[20:]


def serve_arm(server: FirmwareServer, binary: bytes) -> None:
    """Let the server offer the files for 32-bit ARM, with this binary."""
    arm = RELEASE.replace("SITL_x86_64_linux_gnu", "SITL_arm_linux_gnueabihf")
    server.files[f"{arm}git-version.txt"] = server.files[f"{RELEASE}git-version.txt"]
    server.files[f"{arm}arducopter"] = Resource(binary)


@pytest.fixture
def environ(tmp_path: Path) -> dict[str, str]:
    return {"XDG_CACHE_HOME": str(tmp_path / "cache")}


def install_copter(
    server: FirmwareServer,
    environ: dict[str, str],
    version: str = "stable",
    watcher: Onlooker | None = None,
    stall_s: float = 10.0,
) -> InstallOutcome:
    return install("copter", version, environ, watcher or Onlooker(), server.url, stall_s=stall_s)


def the_binary(environ: dict[str, str]) -> bytes:
    found = current("copter", environ)
    assert found is not None
    return found.binary.read_bytes()


def test_install_leaves_executable_parameters_and_manifest(server: FirmwareServer, environ: dict[str, str]) -> None:
    watcher = Onlooker()
    outcome = install_copter(server, environ, watcher=watcher)
    directory = outcome.installed.directory
    assert not outcome.already
    assert directory == cache(environ) / "copter" / "4.6.3"
    assert (directory / "arducopter").read_bytes() == BINARY
    assert (directory / "arducopter").stat().st_mode & stat.S_IXUSR
    assert (directory / "copter.parm").read_bytes() == PARAMETERS
    manifest = json.loads((directory / "manifest.json").read_text())
    assert (manifest["version"], manifest["commit"]) == ("4.6.3", COMMIT)
    assert manifest["files"]["arducopter"]["url"] == server.url + BINARY_PATH
    assert manifest["files"]["arducopter"]["size"] == len(BINARY)
    assert sorted(path.name for path in directory.iterdir()) == ["arducopter", "copter.parm", "manifest.json"]
    assert watcher.seen[-1] == (len(BINARY), len(BINARY))
    assert current("copter", environ) == outcome.installed


def test_second_install_downloads_nothing(server: FirmwareServer, environ: dict[str, str]) -> None:
    install_copter(server, environ)
    server.asked.clear()
    assert install_copter(server, environ).already
    assert [path for path, _ in server.asked] == [f"{RELEASE}git-version.txt"]  # whether the stable version has changed


@pytest.mark.parametrize("version", ["4.6.3", "stable-4.6.3"])
def test_installed_number_needs_no_server(version: str, server: FirmwareServer, environ: dict[str, str]) -> None:
    install_copter(server, environ)
    server.asked.clear()
    assert install_copter(server, environ, version).already
    assert server.asked == []


def test_number_selects_a_stable_release(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.files = {path.replace("/stable/", "/stable-4.6.3/"): file for path, file in server.files.items()}
    assert install_copter(server, environ, "4.6.3").installed.directory.name == "4.6.3"


def test_new_stable_release_is_current_and_the_old_one_is_kept(server: FirmwareServer, environ: dict[str, str]) -> None:
    old = install_copter(server, environ).installed
    server.change(f"{RELEASE}git-version.txt", content=git_version("4.7.0"))
    server.change(BINARY_PATH, content=BINARY + b"new")
    new = install_copter(server, environ).installed
    assert [one.directory.name for one in all_installed("copter", environ)] == ["4.6.3", "4.7.0"]
    assert current("copter", environ) == new
    assert old.damage is None
    assert install_copter(server, environ, "4.6.3").already  # and back to the first version
    assert the_binary(environ) == BINARY


def test_development_builds_of_one_version_are_separate(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(f"{RELEASE}git-version.txt", content=git_version("4.8.0-dev"))
    assert install_copter(server, environ).installed.directory.name == f"4.8.0-dev-{COMMIT[:8]}"


def test_plane_parameters_are_found_in_the_old_place(server: FirmwareServer, environ: dict[str, str]) -> None:
    release = RELEASE.replace("Copter", "Plane")
    server.files = {
        f"{release}git-version.txt": Resource(git_version("4.0.9")),
        f"{release}arduplane": Resource(BINARY),
        PARAMETERS_PATH.replace("copter", "plane"): Resource(b"ARSPD_FBW_MAX 30\n"),
    }
    installed = install("plane", "stable", environ, Onlooker(), server.url).installed
    assert (installed.directory / "plane.parm").read_bytes() == b"ARSPD_FBW_MAX 30\n"


# An interrupted download continues, if the file is still the same.


def test_interrupted_download_is_resumed(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, cut_after=HALF)
    with pytest.raises(DownloadError, match="ended too early: run the same command again"):
        install_copter(server, environ)
    assert current("copter", environ) is None
    server.change(BINARY_PATH, cut_after=None)
    install_copter(server, environ)
    assert server.ranges_of("arducopter") == [None, f"bytes={HALF}-"]
    assert server.statuses_of("arducopter") == [200, 206]
    assert the_binary(environ) == BINARY
    assert not list(cache(environ).glob("**/*.part*"))


@pytest.mark.parametrize("end", [KeyboardInterrupt(), OSError(errno.ENOSPC, "full")], ids=["Ctrl-C", "full disk"])
def test_interrupt_and_full_disk_keep_the_received_part(
    end: BaseException, server: FirmwareServer, environ: dict[str, str]
) -> None:
    with pytest.raises((KeyboardInterrupt, CacheError)):
        install_copter(server, environ, watcher=Onlooker(end))
    (part,) = cache(environ).glob("**/*.part/*.part")
    came = part.stat().st_size
    assert 0 < came < len(BINARY)
    install_copter(server, environ)
    assert server.ranges_of("arducopter") == [None, f"bytes={came}-"]
    assert the_binary(environ) == BINARY


def test_download_restarts_if_the_server_ignores_ranges(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, cut_after=HALF, ranges=False)
    with pytest.raises(DownloadError):
        install_copter(server, environ)
    server.change(BINARY_PATH, cut_after=None)
    install_copter(server, environ)
    assert the_binary(environ) == BINARY


@pytest.mark.parametrize("heeds_if_range", [True, False])
@pytest.mark.parametrize("new", [BINARY[::-1], BINARY + b"more", BINARY[: HALF - 1]], ids=["same size", "more", "less"])
def test_download_restarts_if_the_file_has_changed(
    new: bytes, heeds_if_range: bool, server: FirmwareServer, environ: dict[str, str]
) -> None:
    new = BINARY[:64] + new[64:]
    server.change(BINARY_PATH, cut_after=HALF)
    with pytest.raises(DownloadError):
        install_copter(server, environ)
    server.change(BINARY_PATH, content=new, cut_after=None, heeds_if_range=heeds_if_range)
    install_copter(server, environ)
    assert the_binary(environ) == new


def test_unrequested_range_is_rejected(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, cut_after=HALF)
    with pytest.raises(DownloadError):
        install_copter(server, environ)
    server.change(BINARY_PATH, cut_after=None, range_from=HALF + 1)
    install_copter(server, environ)
    assert server.ranges_of("arducopter") == [None, f"bytes={HALF}-", None]
    assert the_binary(environ) == BINARY


def test_incomplete_range_does_not_end_the_download(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, cut_after=HALF)
    with pytest.raises(DownloadError):
        install_copter(server, environ)
    server.change(BINARY_PATH, cut_after=None, announced=1000)
    with pytest.raises(DownloadError, match="ended too early"):
        install_copter(server, environ)
    server.change(BINARY_PATH, announced=None)
    install_copter(server, environ)
    assert server.ranges_of("arducopter")[-1] == f"bytes={HALF + 1000}-"
    assert the_binary(environ) == BINARY


def test_download_without_validator_is_not_resumed(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, cut_after=HALF, etag=False)
    with pytest.raises(DownloadError):
        install_copter(server, environ)
    server.change(BINARY_PATH, cut_after=None)
    install_copter(server, environ)
    assert server.ranges_of("arducopter") == [None, None]
    assert the_binary(environ) == BINARY


def test_last_modified_replaces_a_weak_etag(server: FirmwareServer, tmp_path: Path) -> None:
    dated = {"Last-Modified": "Mon, 03 Nov 2025 03:38:46 GMT", "ETag": 'W/"weak"'}
    server.change(BINARY_PATH, cut_after=HALF, etag=False, headers=dated)
    with pytest.raises(DownloadError):
        download(server.url + BINARY_PATH, tmp_path / "b", 10**9, Onlooker().downloads)
    assert json.loads((tmp_path / "b.part.json").read_text())["validator"] == dated["Last-Modified"]


@pytest.mark.parametrize("note", ["", "[]", "{}", '{"size": 1, "validator": "x"}', '{"size": "a", "validator": 3}'])
def test_partial_file_with_damaged_note_is_not_resumed(note: str, server: FirmwareServer, tmp_path: Path) -> None:
    (tmp_path / "b.part").write_bytes(b"rubbish")
    (tmp_path / "b.part.json").write_text(note)
    download(server.url + BINARY_PATH, tmp_path / "b", 10**9, Onlooker().downloads)
    assert (tmp_path / "b").read_bytes() == BINARY


# Servers that misbehave.


def test_unknown_version_lists_the_existing_ones(server: FirmwareServer, environ: dict[str, str]) -> None:
    with pytest.raises(RequestError, match=r"there are stable, latest, 4\.10\.0, 4\.6\.3$"):
        install_copter(server, environ, "4.5.1")
    del server.files["/Copter/"]
    with pytest.raises(RequestError, match=r"look at http://.*/Copter/ for those that there are"):
        install_copter(server, environ, "4.5.1")


@pytest.mark.parametrize("version", ["", "..", "../..", "a/b", "4.6.3?", "ä", "-4"])
def test_invalid_version_sends_no_request(version: str, server: FirmwareServer, environ: dict[str, str]) -> None:
    with pytest.raises(RequestError, match="is not a version"):
        install_copter(server, environ, version)
    assert server.asked == []


@pytest.mark.parametrize(
    "base", ["ftp://x", "x", "http://", "http://u:secret@x", "http://x:0", "http://x:y", "http://ä x"]
)
def test_invalid_mirror_is_refused(base: str, environ: dict[str, str]) -> None:
    with pytest.raises(RequestError, match="is not the address of a mirror"):
        install("copter", "stable", environ, Onlooker(), base)


def test_silent_server_ends_the_download_which_is_resumed_later(
    server: FirmwareServer, environ: dict[str, str]
) -> None:
    server.change(BINARY_PATH, silent_after=HALF)
    with pytest.raises(DownloadError, match=r"127\.0\.0\.1:\d+ sent nothing for 0\.2 s"):
        install_copter(server, environ, stall_s=0.2)
    server.change(BINARY_PATH, silent_after=None)
    install_copter(server, environ)
    assert server.ranges_of("arducopter")[1] is not None
    assert the_binary(environ) == BINARY


def test_redirect_is_followed(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.files["/elsewhere"] = server.files[BINARY_PATH]
    server.files[BINARY_PATH] = Resource(b"", 302, {"Location": "/elsewhere"})
    install_copter(server, environ)
    assert the_binary(environ) == BINARY


def test_redirect_to_an_unencrypted_address_is_refused() -> None:
    request, headers = urllib.request.Request("https://a.example/x"), Message()
    with pytest.raises(DownloadError, match=r"leads to http://b\.example/x, which is not encrypted"):
        HttpsRedirectHandler().redirect_request(request, io.BytesIO(), 302, "Found", headers, "http://b.example/x")
    followed = HttpsRedirectHandler().redirect_request(
        request, io.BytesIO(), 302, "Found", headers, "https://b.example/x"
    )
    assert followed is not None


def test_web_page_is_not_accepted_as_a_binary(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, content=b"<!DOCTYPE html><html>Please log in</html>")
    with pytest.raises(DownloadError, match="is not a program for Linux on x86_64, but begins with b'<!DOCTYPE"):
        install_copter(server, environ)
    server.change(BINARY_PATH, content=BINARY)
    install_copter(server, environ)
    assert the_binary(environ) == BINARY


def test_program_for_another_processor_is_refused(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, content=BINARY[:18] + b"\xb7" + BINARY[19:])
    with pytest.raises(DownloadError, match="is not a program for Linux on x86_64"):
        install_copter(server, environ)


@pytest.mark.parametrize("path", [f"{RELEASE}git-version.txt", PARAMETERS_PATH])
def test_web_page_is_not_accepted_as_a_text(path: str, server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(path, content=b"<!DOCTYPE html>\n<html>Please log in\n</html>")
    with pytest.raises(DownloadError, match=r"does not name a commit|has no ArduPilot parameters"):
        install_copter(server, environ)


def test_truncated_parameters_are_an_error(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(PARAMETERS_PATH, cut_after=30)
    with pytest.raises(DownloadError, match="ended too early"):
        install_copter(server, environ)
    assert current("copter", environ) is None


def test_missing_parameters_name_the_last_place(server: FirmwareServer, environ: dict[str, str]) -> None:
    del server.files[PARAMETERS_PATH]
    with pytest.raises(DownloadError, match=r"default_params/copter\.parm does not exist: install another --version"):
        install_copter(server, environ)


def test_too_large_file_is_refused_before_the_download(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, announced=100_000_001)
    with pytest.raises(DownloadError, match=r"has 100\.0 MB, more than 100\.0 MB"):
        install_copter(server, environ)
    assert not list(cache(environ).glob("**/arducopter*"))


def test_endless_text_is_aborted(server: FirmwareServer) -> None:
    server.files["/text"] = Resource(b"x" * 3000)
    with pytest.raises(DownloadError, match="is larger than"):
        fetch_text(f"{server.url}/text", 2000)


@pytest.mark.parametrize("how", [{"sized": False}, {"chunked": True}], ids=["until closed", "chunked"])
def test_binary_of_unknown_size_is_refused(
    how: dict[str, bool], server: FirmwareServer, environ: dict[str, str]
) -> None:
    server.change(BINARY_PATH, **how)
    with pytest.raises(DownloadError, match="does not say how large"):
        install_copter(server, environ)


def test_text_may_be_chunked_but_needs_an_end(server: FirmwareServer) -> None:
    server.files["/text"] = Resource(PARAMETERS, chunked=True)
    assert fetch_text(f"{server.url}/text", 1000).encode() == PARAMETERS
    server.change("/text", cut_after=20)
    with pytest.raises(DownloadError, match="ended too early"):
        fetch_text(f"{server.url}/text", 1000)
    server.files["/text"] = Resource(PARAMETERS, sized=False)
    with pytest.raises(DownloadError, match="does not say how large"):
        fetch_text(f"{server.url}/text", 1000)


def test_server_error_is_reported(server: FirmwareServer, environ: dict[str, str]) -> None:
    server.change(BINARY_PATH, status=503)
    with pytest.raises(DownloadError, match=r"answers 503 \(Service Unavailable\)"):
        install_copter(server, environ)


def test_missing_file_raises_not_there_error(server: FirmwareServer, tmp_path: Path) -> None:
    with pytest.raises(NotThereError):
        download(f"{server.url}/nowhere", tmp_path / "b", 1000, Onlooker().downloads)


def test_missing_network_suggests_another_machine(environ: dict[str, str]) -> None:
    with serving() as server:
        pass  # the server is closed
    with pytest.raises(UnreachableError, match=r"cannot be reached \(Connection refused\).*set ARDUPILOT_SITL to it$"):
        install_copter(server, environ)


# The cache.


def test_impossible_cache_names_the_solution(server: FirmwareServer, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CacheError, match=r"cannot be written \(Not a directory\).*set XDG_CACHE_HOME"):
        install_copter(server, {"XDG_CACHE_HOME": str(tmp_path / "file")})


def test_read_only_cache_names_the_solution(
    server: FirmwareServer, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_only(path: Path, *_: object, **__: object) -> None:  # root may write anywhere, so the error is simulated
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(Path, "mkdir", read_only)
    with pytest.raises(CacheError, match=r"/copter cannot be written \(Read-only file system\)"):
        install_copter(server, environ)


def test_full_disk_is_reported(server: FirmwareServer, environ: dict[str, str]) -> None:
    part = cache(environ) / "copter" / ".4.6.3.part"
    part.mkdir(parents=True)
    (part / "copter.parm").symlink_to("/dev/full")
    with pytest.raises(CacheError, match="is full: free some space, and run the same command again"):
        install_copter(server, environ)
    (part / "copter.parm").unlink()
    install_copter(server, environ)
    assert server.ranges_of("arducopter") == [None]  # the binary was installed before


def test_missing_home_gives_no_cache() -> None:
    for environ in ({}, {"XDG_CACHE_HOME": "relative"}, {"HOME": ""}):
        with pytest.raises(VehicleError, match="set XDG_CACHE_HOME"):
            cache(environ)
        assert current("copter", environ) is None
    assert cache({"HOME": "/h", "XDG_CACHE_HOME": "relative"}) == Path("/h/.cache/ucp-harness/sitl")


@pytest.mark.parametrize("name", ["arducopter", "copter.parm", "manifest.json"])
@pytest.mark.parametrize("harm", ["changed", "gone"])
def test_changed_file_is_not_used_and_is_replaced(
    name: str, harm: str, server: FirmwareServer, environ: dict[str, str]
) -> None:
    directory = install_copter(server, environ).installed.directory
    if harm == "gone":
        (directory / name).unlink()
    else:
        with (directory / name).open("r+b") as file:
            file.write(b"X")
    with pytest.raises(UnusableBinaryError, match=f"damaged, {name} .*run `ucp-harness sitl install --vehicle copter`"):
        current("copter", environ)
    assert not install_copter(server, environ).already
    assert the_binary(environ) == BINARY


@pytest.mark.parametrize("manifest", ["3", "{}", '{"files": []}', '{"files": {"arducopter": 3}}', '{"files": {}}'])
def test_invalid_manifest_counts_as_damage(manifest: str, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(manifest)
    assert InstalledVersion("copter", tmp_path).damage == "manifest.json is missing or cannot be read"


def test_file_missing_in_the_manifest_counts_as_damage(server: FirmwareServer, environ: dict[str, str]) -> None:
    directory = install_copter(server, environ).installed.directory
    manifest = json.loads((directory / "manifest.json").read_text())
    del manifest["files"]["arducopter"]
    (directory / "manifest.json").write_text(json.dumps(manifest))
    assert InstalledVersion("copter", directory).damage == "arducopter is not the file that was fetched (SHA-256)"


def test_binary_without_execute_permission_counts_as_damage(server: FirmwareServer, environ: dict[str, str]) -> None:
    installed = install_copter(server, environ).installed
    installed.binary.chmod(0o644)
    assert InstalledVersion("copter", installed.directory).damage == "arducopter is not executable"


def test_install_waits_for_a_concurrent_install(server: FirmwareServer, environ: dict[str, str]) -> None:
    home = cache(environ) / "copter"
    install_copter(server, environ)
    server.asked.clear()
    watcher, outcomes = Onlooker(), list[InstallOutcome]()
    waiting = threading.Thread(
        target=lambda: outcomes.append(install_copter(server, environ, watcher=watcher)), daemon=True
    )
    with (home / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        waiting.start()
        assert watcher.waited.wait(10)
        assert server.asked == []
    waiting.join(10)
    assert outcomes[0].already


def test_concurrent_installs_download_the_binary_once(server: FirmwareServer, environ: dict[str, str]) -> None:
    outcomes: list[InstallOutcome] = []
    threads = [
        threading.Thread(target=lambda: outcomes.append(install_copter(server, environ)), daemon=True) for _ in range(5)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert sorted(outcome.already for outcome in outcomes) == [False, True, True, True, True]
    assert server.ranges_of("arducopter") == [None]


def test_unfinished_installs_are_removed(server: FirmwareServer, environ: dict[str, str]) -> None:
    left = cache(environ) / "copter" / ".4.8.0-dev-01234567.part"
    left.mkdir(parents=True)
    (left.parent / ".current").symlink_to("nowhere")
    install_copter(server, environ)
    assert sorted(path.name for path in left.parent.iterdir()) == [".lock", "4.6.3", "current"]


@pytest.mark.parametrize("machine", ["riscv64", "ppc64le"])
def test_unsupported_machine_gets_a_solution(
    machine: str, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    with pytest.raises(VehicleError, match=f"this is linux on {machine}: build ArduPilot SITL from source"):
        install("copter", "stable", environ, Onlooker(), "http://127.0.0.1:1")


def test_32_bit_arm_gets_its_own_binary(
    server: FirmwareServer, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "armv7l")
    with pytest.raises(RequestError, match="SITL_arm_linux_gnueabihf"):
        install_copter(server, environ)
    serve_arm(server, BINARY)
    with pytest.raises(DownloadError, match="is not a program for Linux on 32-bit ARM"):
        install_copter(server, environ)
    serve_arm(server, ARM_BINARY)
    install_copter(server, environ)
    assert the_binary(environ) == ARM_BINARY


def test_aarch64_without_32_bit_support_is_refused(
    server: FirmwareServer, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine in the test has no support for 32-bit programs."""
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    serve_arm(server, ARM_BINARY)
    with pytest.raises(VehicleError, match="this aarch64 does not run programs of 32 bits: build ArduPilot SITL"):
        install_copter(server, environ)
    assert current("copter", environ) is None


def test_aarch64_with_32_bit_support_is_accepted(
    server: FirmwareServer, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    monkeypatch.setattr("sitl.firmware.subprocess.run", lambda *_, **__: None)
    serve_arm(server, ARM_BINARY)
    install_copter(server, environ)
    assert the_binary(environ) == ARM_BINARY


# Flights with installed binaries


def test_installed_binary_is_the_default(server: FirmwareServer, environ: dict[str, str]) -> None:
    with pytest.raises(NoBinaryError, match="none is installed; run `ucp-harness sitl install --vehicle copter`"):
        ArduPilot.find(None, environ)
    directory = install_copter(server, environ).installed.directory
    found = ArduPilot.find(None, environ)
    assert found.binary.samefile(directory / "arducopter")
    assert [path.name for path in found.defaults] == ["copter.parm"]


def test_environment_and_path_precede_the_installed_binary(
    server: FirmwareServer, environ: dict[str, str], tmp_path: Path
) -> None:
    install_copter(server, environ)
    other = tmp_path / "arducopter"
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    for variable in ("PATH", "ARDUPILOT_SITL"):
        assert ArduPilot.find(None, {**environ, variable: str(tmp_path)}).binary == other


def test_damaged_installed_binary_is_not_used(server: FirmwareServer, environ: dict[str, str]) -> None:
    install_copter(server, environ).installed.binary.write_bytes(BINARY[:-1])
    with pytest.raises(UnusableBinaryError, match="is damaged, arducopter is not the file that was fetched"):
        ArduPilot.find(None, environ)


def test_parameters_of_frames_are_downloaded_if_they_exist(server: FirmwareServer, environ: dict[str, str]) -> None:
    tree = PARAMETERS_PATH.removesuffix("default_params/copter.parm")
    for name in ("default_params/copter-hexa.parm", "models/copter-single.parm"):
        server.files[f"{tree}{name}"] = Resource(b"FRAME_CLASS 2\n")
    directory = install("copter", "stable", environ, Onlooker(), server.url).installed.directory
    hexa = ArduPilot.find(directory / "arducopter", {}, "copter", VehicleSetup(frame="hexa"))
    assert [path.name for path in hexa.defaults] == ["copter.parm", "copter-hexa.parm"]
    assert ArduPilot.find(directory / "arducopter", {}, "copter", VehicleSetup(frame="octa")).missing == (
        "copter-octa.parm",
    )
    assert (directory / "copter-single.parm").exists()
    (directory / "copter-hexa.parm").write_text("FRAME_CLASS 3\n")
    assert InstalledVersion("copter", directory).damage == "copter-hexa.parm is not the file that was fetched (SHA-256)"
