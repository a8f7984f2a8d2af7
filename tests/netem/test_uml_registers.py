"""Test floating point and vector registers in User Mode Linux, on this processor and on an unknown one."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from netem import _uml_registers, uml
from netem.errors import UmlError
from tests.machine import do_without, require_uml

PROGRAMS = Path(__file__).with_name("registers")
SECONDS = 3


KERNEL = shutil.which("linux.uml")
WAYS = ["as here"] if _uml_registers.needed(Path(KERNEL) if KERNEL else None) else ["as here", "preloaded"]


@pytest.fixture(params=WAYS)
def guest(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run User Mode Linux in two ways: normally, and with the register library although this processor does not need
    it.
    """
    if request.param == "preloaded":
        monkeypatch.setenv(_uml_registers.FORCE, "1")
    require_uml()


@pytest.fixture(scope="module")
def check(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile the program that checks its own registers. If registers are lost, the program prints them and ends with
    status 1.
    """
    program = tmp_path_factory.mktemp("registers") / "check"
    argv = ["cc", "-O1", "-fno-builtin", "-pthread", "-o", str(program), str(PROGRAMS / "check.c")]
    if not _uml_registers.has_compiler():
        do_without("cc", "no C compiler (Debian packages `gcc` and `libc6-dev`)")
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        do_without("cc", f"this C compiler makes no programs (Debian package `libc6-dev`): {done.stderr}")
    return program


@pytest.mark.uml
@pytest.mark.any_user
def test_threads_children_and_signals_leave_registers_alone(
    guest: None, check: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    status = run(str(check), str(SECONDS))
    said = capfd.readouterr().out
    assert status == 0, said
    looks, interruptions, children = (int(part.split()[0]) for part in said.split(";")[0].split(","))
    assert looks > 20 and interruptions > 20 and children > 4


@pytest.mark.uml
@pytest.mark.any_user
def test_hashes_copies_and_floats_equal_those_of_the_host(guest: None, capfd: pytest.CaptureFixture[str]) -> None:
    argv = [sys.executable, str(PROGRAMS / "work.py")]
    here = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    assert run("timeout", "60", *argv) == 0
    assert capfd.readouterr().out == here


@pytest.mark.uml
@pytest.mark.any_user
def test_lost_registers_are_detected(
    check: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(_uml_registers.FORCE, "1")
    require_uml()
    if " avx " not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no more registers than what is kept anyway")
    monkeypatch.setattr(_uml_registers, "SOURCE", PROGRAMS / "forgetful.c")
    assert run(str(check), str(SECONDS)) == 1
    assert " 0 vector" not in capfd.readouterr().out


@pytest.mark.parametrize(
    ("flags", "version", "needed"),
    [
        ({"fpu"}, "6.1.176", True),
        ({"fpu"}, "6.12.9", True),
        ({"fpu"}, "6.13.0-rc1", False),
        ({"fpu"}, "7.0", False),
        ({"fpu"}, "what is --version?", True),
        ({"of a processor to come"}, "6.1.176", False),
    ],
)
def test_old_kernels_on_new_processors_need_the_register_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: set[str], version: str, needed: bool
) -> None:
    monkeypatch.delenv(_uml_registers.FORCE, raising=False)
    monkeypatch.setattr(_uml_registers, "_FLAGS", flags)
    kernel = tmp_path / "linux.uml"
    kernel.write_text(f"#!/bin/sh\necho '{version}'\n")
    kernel.chmod(0o755)
    assert _uml_registers.needed(kernel) is needed


def test_missing_compiler_is_named_where_it_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv(_uml_registers.FORCE, "1")
    with pytest.raises(UmlError, match=r"apt install .*gcc"):
        uml.find()


def test_failed_compiler_is_an_error_with_its_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\necho 'as: not found' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(UmlError, match=r"cc could not compile \(as: not found\).*--reinstall gcc"):
        _uml_registers.preload(tmp_path)


@pytest.mark.uml
@pytest.mark.any_user
def test_temporary_directory_may_have_any_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, guest: None, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a space, a colon: and more"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    assert run("echo", "up") == 0
    assert capfd.readouterr().out == "up\n"
    assert not [*folder.iterdir()]


def run(*argv: str) -> int:
    return uml.run([*argv], cwd=Path("/"), env={"PATH": uml.SYSTEM_PATH})
