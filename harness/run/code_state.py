"""Check out earlier commits of the code in a clone, and run processes with them.

The clone shares the objects of the repository, but has its own working tree, index and `git bisect` state. The
repository therefore never changes. If the process is killed, only one temporary directory remains.
"""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from harness.errors import HarnessError, InterruptedRunError, MachineError

ROOT = Path(__file__).parents[2]
"""The directory that contains the code of the running harness."""
GRACE_S = 30.0
"""Maximum number of seconds that a run may take to stop after SIGTERM. The run needs this time to remove its
network.
"""


@dataclass(frozen=True)
class ProcessResult:
    """The result of a process that ended or was stopped."""

    status: int | None
    """The exit status. None if the process exceeded its time limit and was stopped."""
    stdout: str
    stderr: str

    @property
    def last_error_line(self) -> str:
        """The last line that the process wrote to standard error, without the name of the program."""
        lines = [line.strip() for line in self.stderr.splitlines() if line.strip()]
        return lines[-1].removeprefix("ucp-harness: ")[:300] if lines else "it printed nothing"

    def raised_in(self, directory: Path) -> str | None:
        """Return the exception that ended the process, with the last line of its traceback that is in `directory`.

        Return None if no line of the traceback is in this directory.
        """
        if "Traceback (most recent call last)" not in self.stderr:
            return None
        frames = re.findall(r'File "([^"\n]+)", line (\d+), in (\S+)', self.stderr)
        matching_frames = [
            (Path(file), line, name) for file, line, name in frames if Path(file).is_relative_to(directory)
        ]
        if not matching_frames:
            return None
        file, line, name = matching_frames[-1]
        return f"{self.last_error_line} ({file.relative_to(directory.parent)}:{line}, {name})"


def run_python(
    arguments: Sequence[str], *, first: Sequence[Path], cwd: Path, limit_s: float | None, stdin: str | None = None
) -> ProcessResult:
    """Run a Python program with this interpreter. The directories in `first` are at the beginning of its module search
    path.

    The process has its own session. If the caller is interrupted, the process receives SIGTERM. If it has not ended
    after GRACE_S seconds, it receives SIGKILL.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, first)),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NO_COLOR": "1",
        "COLUMNS": "200",
    }
    environment.pop("PYTHONHOME", None)
    process = subprocess.Popen(
        [sys.executable, "-P", *arguments],
        cwd=cwd,
        env=environment,
        stdin=subprocess.DEVNULL if stdin is None else subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        stdout, stderr = process.communicate(stdin, timeout=limit_s)
        return ProcessResult(process.returncode, stdout, stderr)
    except subprocess.TimeoutExpired:
        return ProcessResult(None, "", "")
    finally:
        _stop(process)


def _stop(process: "subprocess.Popen[str]") -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_S)
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            with suppress(OSError, ValueError):
                stream.close()


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C inside the context, so that temporary files are removed. Raises InterruptedRunError."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedRunError("interrupted; all temporary files are removed") from None
    finally:
        signal.signal(signal.SIGTERM, before)


Mark = Literal["good", "bad", "skip"]

_FIRST_BAD = re.compile(r"^([0-9a-f]{40,64}) is the first", re.MULTILINE)
_HASH_LINE = re.compile(r"^([0-9a-f]{40,64})$", re.MULTILINE)
_ENVIRONMENT = {"LC_ALL": "C", "GIT_TERMINAL_PROMPT": "0", "GIT_LFS_SKIP_SMUDGE": "1"}
_GIT_LOCATION_VARIABLES = (
    "GIT_DIR",
    "GIT_WORK_TREE",
    "GIT_INDEX_FILE",
    "GIT_OBJECT_DIRECTORY",
    "GIT_COMMON_DIR",
    "GIT_PREFIX",
)
"""Environment variables that make git use a different repository. A hook or `git bisect run` may have set them."""


class RepositoryError(HarnessError):
    """An error: git cannot search this repository, or the repository does not contain the revision."""


@dataclass(frozen=True)
class GitCommit:
    """A git commit."""

    hash: str
    date: str
    author: str
    subject: str
    files: tuple[str, ...] = ()
    """Paths of the changed files."""

    @property
    def sentence(self) -> str:
        return f"{self.hash[:12]}, {self.date}, {self.author}: {self.subject}"


@dataclass(frozen=True)
class SuspectCommits:
    """The result of a search for the first bad commit."""

    first: tuple[str, ...]
    """Hash of the first bad commit. If some commits could not be tested, it contains the hashes of several
    candidates.
    """


class GitBisection:
    """A clone of the repository, in which `git bisect` searches for the first bad commit. `tree` is its working
    directory.
    """

    def __init__(self, repository: Path, tree: Path) -> None:
        self._repository = repository
        self.tree = tree

    @classmethod
    def clone(cls, repository: Path, tree: Path) -> "GitBisection":
        """Clone the repository into the directory `tree`. Raises RepositoryError."""
        history = cls(repository, tree)
        top = history._git(repository, "rev-parse", "--git-common-dir").strip()
        source = str((repository / top).resolve())
        history._git(tree.parent, "clone", "--quiet", "--shared", "--no-checkout", "--", source, str(tree))
        return history

    def resolve(self, revision: str) -> str:
        """Return the hash of the commit that a revision names. Raises RepositoryError."""
        try:
            commit_expression = f"{revision}^{{commit}}"
            return self._git(
                self._repository, "rev-parse", "--verify", "--quiet", "--end-of-options", commit_expression
            ).strip()
        except RepositoryError:
            raise RepositoryError(f"{self._repository}: no commit {revision!r}; `git log` lists the commits") from None

    def check_out(self, commit: str) -> None:
        self._git(self.tree, "checkout", "--quiet", "--force", "--detach", commit)
        self._git(self.tree, "clean", "--quiet", "-xffd")

    def between(self, good: str, bad: str) -> int:
        """Return the number of commits that the search must consider: those after the commit `good`, up to and
        including the commit `bad`.
        """
        return int(self._git(self.tree, "rev-list", "--count", f"{good}..{bad}"))

    def begin(self, good: str, bad: str) -> "str | SuspectCommits":
        """Start the search for the first bad commit. Check out the first commit to test, and return its hash."""
        return self._next(self._git(self.tree, "bisect", "start", bad, good, accept=(0, 2)))

    def mark(self, mark: Mark) -> "str | SuspectCommits":
        """Record the verdict on the commit that is checked out, and check out the next commit to test. Return the hash
        of the next commit, or the result of the search.
        """
        return self._next(self._git(self.tree, "bisect", mark, accept=(0, 2)))

    def _next(self, output: str) -> "str | SuspectCommits":
        if first := _FIRST_BAD.search(output):
            return SuspectCommits((first[1],))
        if "could be any of" in output:
            return SuspectCommits(tuple(_HASH_LINE.findall(output)))
        self._git(self.tree, "clean", "--quiet", "-xffd")
        return self._git(self.tree, "rev-parse", "HEAD").strip()

    def commit(self, commit: str) -> GitCommit:
        form = "--format=%H%x00%as%x00%an%x00%s%x00"
        output = self._git(self.tree, "show", "--no-patch", form, commit)
        parts = output.split("\0")
        names = self._git(self.tree, "diff-tree", "--no-commit-id", "--name-only", "-r", "-m", "--root", commit)
        return GitCommit(parts[0].strip(), parts[1], parts[2], parts[3], tuple(dict.fromkeys(names.splitlines())))

    def _git(self, where: Path, *arguments: str, accept: tuple[int, ...] = (0,)) -> str:
        environment = {
            key: value for key, value in os.environ.items() if key not in _GIT_LOCATION_VARIABLES
        } | _ENVIRONMENT
        try:
            process = subprocess.run(
                ["git", "-c", "core.hooksPath=/dev/null", "-c", "advice.detachedHead=false", *arguments],
                cwd=where,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
            )
        except FileNotFoundError:
            raise MachineError("git is not installed: apt install git") from None
        except NotADirectoryError:
            raise RepositoryError(f"{where}: not a directory") from None
        if process.returncode not in accept:
            output = " ".join((process.stderr.strip() or process.stdout.strip()).split())
            if "not a git repository" in output:
                raise RepositoryError(f"{where}: not in a git repository; name one with --repository")
            raise RepositoryError(f"{where}: git {arguments[0]}: {output[:300] or f'ended with {process.returncode}'}")
        return process.stdout + (process.stderr if arguments[0] == "bisect" else "")
