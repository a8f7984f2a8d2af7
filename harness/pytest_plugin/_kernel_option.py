"""Implement `--ucp-kernel uml`, which runs all tests in User Mode Linux, with netem and without root."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

from harness.backend_names import BackendName
from harness.errors import MachineError
from harness.play.backends import BACKENDS, in_virtual_time
from netem import uml
from netem.errors import UmlError


def session_inside(config: pytest.Config) -> int | None:
    """Run all tests in User Mode Linux with the same command line, and return the exit status. The files of failed
    tests remain after the guest has ended.

    Return None in two cases: the session already runs in User Mode Linux, or User Mode Linux is missing. In the second
    case, `refuse_outside` skips the tests that need it.
    """
    if uml.inside() or _missing() is not None:
        return None
    folder = Path(tempfile.mkdtemp(prefix="pytest-uml-"))
    kept = [] if config.option.basetemp else [f"--basetemp={folder / 'tests'}"]
    on_path = [] if str(Path.cwd()) in sys.path else ["-P"]  # only `python -m pytest` adds it to the path
    command = [sys.executable, *on_path, "-m", "pytest", *config.invocation_params.args, *kept]
    try:
        status = uml.run(command, cwd=config.invocation_params.dir, env=os.environ)
    except UmlError as error:
        raise pytest.UsageError(f"--ucp-kernel: {error}") from None
    if status == pytest.ExitCode.OK or not kept:
        shutil.rmtree(folder, ignore_errors=True)
    return status


def refuse_outside(backend: BackendName) -> None:
    """Raise MachineError if this backend needs User Mode Linux and the tests do not run in it."""
    if in_virtual_time(backend):
        return
    if why := BACKENDS[backend].not_in_uml:
        raise MachineError(why)
    if why := _missing():
        raise MachineError(f"--ucp-kernel uml: {why}")


def _missing() -> str | None:
    if uml.inside():
        return None
    try:
        uml.find()
    except UmlError as error:
        return str(error)
    return None
