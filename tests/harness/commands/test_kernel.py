"""Test the option `--kernel uml`, which runs commands in User Mode Linux."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from netem import uml
from netem.errors import UmlError
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences, write_scenario

QUICK = {"agents": 2, "duration_s": 20, "speedup": 20, "events": {"source": "random", "mean_s": 2}}
WAITING = """
import sys
from pathlib import Path
from netem import uml
waiting = "trap 'echo Ctrl-C; exit 130' INT; echo here; while :; do sleep 0.1; done"
sys.exit(uml.run(["sh", "-c", waiting], cwd=Path("/"), env={"PATH": uml.SYSTEM_PATH}))
"""
LATE_BEAT = """
from netem import uml
beats = "while echo; do sleep {beat_s}; done"
assert beats in uml._COMMAND
uml._COMMAND = uml._COMMAND.replace(beats, "while sleep {beat_s}; do echo; done")
"""
"""Code that makes the guest send its first sign of life BEAT_S seconds after the start of the command, and not at
once.
"""


@pytest.mark.uml
def test_run_in_uml_leaves_verdict_report_and_status(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, **QUICK, network={"delay": 0.1})
    done = harness("run", scenario, "--kernel", "uml", "--vehicles", "none", "--seed", "7", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("holds") == 6
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["outcome"], record["engine"], record["seed"]) == ("completed", "netem", 7)
    assert "User Mode Linux" in record["versions"]["kernel"]
    written = {path.name for path in tmp_path.glob("run/**/*")}
    assert {"report.html", "network.jsonl", "1.chain.json", "2.trace.jsonl"} <= written
    assert all(path.stat().st_uid == os.geteuid() for path in tmp_path.glob("run/**/*"))
    assert harness("check", tmp_path / "run").returncode == 0


@pytest.mark.uml
def test_shell_enters_a_run_in_uml_that_is_judged_when_interrupted(tmp_path: Path) -> None:
    run = tmp_path / "run"
    scenario = write_scenario(tmp_path, **{**QUICK, "duration_s": 100_000})
    asked = ("run", str(scenario), "--kernel", "uml", "--vehicles", "none", "--out", str(run))
    with _UmlProgram(tmp_path, *COMMAND, *asked) as started:
        started.wait_for("mission;")
        assert f"{run}: inside User Mode Linux\n" in harness("shell").stdout
        inside = harness("shell", run, 2, "--", "sh", "-c", "ip -brief address; exit 7", deadline_s=DEADLINE_S)
        assert (inside.returncode, "10.77.0.2/14" in inside.stdout) == (7, True), inside
        started.process.send_signal(signal.SIGINT)
        rest, errors = started.process.communicate(timeout=DEADLINE_S)
    assert started.process.returncode == 130
    assert "interrupted at mission second" in errors
    assert "holds" in rest
    assert {path.name for path in run.glob("agents/*.chain.json")} == {"1.chain.json", "2.chain.json"}
    assert (run / "report.html").exists()
    started.wait_for_clean_end()


@pytest.mark.uml
@pytest.mark.any_user
@pytest.mark.parametrize("before", ["", LATE_BEAT], ids=["beating", "output-before-first-beat"])
def test_sigterm_reaches_the_command_as_ctrl_c(tmp_path: Path, before: str) -> None:
    with _UmlProgram(tmp_path, sys.executable, "-c", before + WAITING) as started:
        started.wait_for("here")
        started.process.terminate()
        rest, _ = started.process.communicate(timeout=DEADLINE_S)
    assert (started.process.returncode, rest) == (130, "Ctrl-C\n")
    started.wait_for_clean_end()


@pytest.mark.uml
@pytest.mark.any_user
def test_killed_program_leaves_no_uml_processes_or_files(tmp_path: Path) -> None:
    with _UmlProgram(tmp_path, sys.executable, "-c", WAITING) as started:
        started.wait_for("here")
        assert started.remaining_processes()
        started.process.kill()
        started.process.wait()
        started.wait_for_clean_end()


@pytest.mark.uml
@pytest.mark.any_user
def test_uml_passes_exit_status_and_both_outputs_on(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lines = 20000
    assert _run(f"seq {lines}; echo complaint >&2; exit 7") == 7
    out, err = capfd.readouterr()
    assert out == "".join(f"{number}\n" for number in range(1, lines + 1))
    assert err == "complaint\n"


@pytest.mark.uml
@pytest.mark.any_user
def test_kernel_panic_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UmlError, match="panic"):
        _run("echo c >/proc/sysrq-trigger; sleep 60")


@pytest.mark.uml
@pytest.mark.any_user
def test_silent_kernel_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uml, "SILENCE_LIMIT_S", 3.0)
    monkeypatch.setattr(uml, "BEAT_S", 60)
    with pytest.raises(UmlError, match="it printed nothing for 3 s"):
        _run("sleep 60")


@pytest.mark.uml
@pytest.mark.any_user
def test_kernel_that_does_not_boot_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uml, "MEMORY", "nonsense")
    with pytest.raises(UmlError, match="it did not boot"):
        _run("true")


def test_missing_user_mode_linux_is_refused_with_a_solution(tmp_path: Path) -> None:
    asked = ("run", write_scenario(tmp_path), "--kernel", "uml", "--out", tmp_path / "run")
    done = harness(*asked, env={**os.environ, "PATH": str(tmp_path)})
    assert done.returncode == 3
    (sentence,) = sentences(done.stderr)
    assert "apt install user-mode-linux" in sentence
    assert not (tmp_path / "run").exists()


def test_virtual_time_refuses_a_kernel(tmp_path: Path) -> None:
    asked = ("run", write_scenario(tmp_path), "--kernel", "uml", "--backend", "sim", "--out", tmp_path / "run")
    done = harness(*asked)
    assert done.returncode == 2
    assert "--backend sim" in sentences(done.stderr)[0]
    assert not (tmp_path / "run").exists()


def _run(script: str) -> int:
    return uml.run(["sh", "-c", script], cwd=Path("/"), env={"PATH": uml.SYSTEM_PATH})


class _UmlProgram:
    """A program that starts User Mode Linux. When it ends, it must remove all files in the directory `temporary`."""

    def __init__(self, folder: Path, *command: str) -> None:
        self.temporary = folder / "tmp"
        self.temporary.mkdir()
        self.process = subprocess.Popen(
            command,
            env={**os.environ, "TMPDIR": str(self.temporary)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_for(self, word: str) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if word in line:
                return
        pytest.fail(f"it ended before it said {word}: {self.process.communicate()}")

    def remaining_processes(self) -> list[str]:
        """Return the command lines of the User Mode Linux processes that the program started. Each of them contains the
        name of the directory `temporary`.
        """
        found = []
        for entry in Path("/proc").iterdir():
            try:
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if f"uml_dir={self.temporary}" in command:
                found.append(command)
        return found

    def wait_for_clean_end(self) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while remaining := [*self.remaining_processes(), *self.temporary.iterdir()]:
            assert time.monotonic() < deadline, f"still there: {remaining}"
            time.sleep(0.05)

    def __enter__(self) -> "_UmlProgram":
        return self

    def __exit__(self, *_: Any) -> None:
        self.process.kill()
        self.process.communicate()
