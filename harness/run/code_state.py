"""States of the code: commits of a repository, each checked out in a clone, and processes that run with them.

The clone shares the repository's objects and has everything else for itself: working tree, index, and the state of
`git bisect`. So the repository and its working tree stay as they are, whatever happens, and what a clone leaves behind
that was killed is one temporary directory.
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
"""Of the harness that runs now."""
GRACE_S = 30.0
"""A run that is asked to stop takes its lab down first."""


@dataclass(frozen=True)
class Ended:
    """How a process ended; `status` is None if it took too long and was stopped."""

    status: int | None
    stdout: str
    stderr: str

    @property
    def last_words(self) -> str:
        lines = [line.strip() for line in self.stderr.splitlines() if line.strip()]
        return lines[-1].removeprefix("ucp-harness: ")[:300] if lines else "it said nothing"

    def raised_in(self, directory: Path) -> str | None:
        """The exception that ended it, and the innermost line of `directory` that it came through; None if none did."""
        if "Traceback (most recent call last)" not in self.stderr:
            return None
        frames = re.findall(r'File "([^"\n]+)", line (\d+), in (\S+)', self.stderr)
        ours = [(Path(file), line, name) for file, line, name in frames if Path(file).is_relative_to(directory)]
        if not ours:
            return None
        file, line, name = ours[-1]
        return f"{self.last_words} ({file.relative_to(directory.parent)}:{line}, {name})"


def run_python(
    arguments: Sequence[str], *, first: Sequence[Path], cwd: Path, limit_s: float | None, stdin: str | None = None
) -> Ended:
    """Run this interpreter with these directories before all other places of modules.

    It has a session of its own, and is stopped in order, then at all events, if whoever waits for it is interrupted.
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
        return Ended(process.returncode, stdout, stderr)
    except subprocess.TimeoutExpired:
        return Ended(None, "", "")
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
    """What is inside is interrupted by SIGTERM as by Ctrl-C, and leaves nothing behind. Raises InterruptedRunError."""

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
_FOREIGN = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_COMMON_DIR", "GIT_PREFIX")
"""What a hook or `git bisect run` may have set, and would lead git elsewhere."""


class RepositoryError(HarnessError):
    """The repository, or a revision, is not one that can be bisected."""


@dataclass(frozen=True)
class Commit:
    """`files` are those that it changes, as git names them."""

    hash: str
    date: str
    author: str
    subject: str
    files: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        return f"{self.hash[:12]}, {self.date}, {self.author}: {self.subject}"


@dataclass(frozen=True)
class Narrowed:
    """The first bad commit, or those that it may be, where what lies between cannot be tried."""

    first: tuple[str, ...]


class History:
    """Made by `clone`; `tree` is its working tree."""

    def __init__(self, repository: Path, tree: Path) -> None:
        self._repository = repository
        self.tree = tree

    @classmethod
    def clone(cls, repository: Path, tree: Path) -> "History":
        """Raises RepositoryError."""
        history = cls(repository, tree)
        top = history._git(repository, "rev-parse", "--git-common-dir").strip()
        source = str((repository / top).resolve())
        history._git(tree.parent, "clone", "--quiet", "--shared", "--no-checkout", "--", source, str(tree))
        return history

    def resolve(self, revision: str) -> str:
        """The commit that a revision of the repository is. Raises RepositoryError."""
        try:
            asked = f"{revision}^{{commit}}"
            return self._git(self._repository, "rev-parse", "--verify", "--quiet", "--end-of-options", asked).strip()
        except RepositoryError:
            raise RepositoryError(f"{self._repository}: no commit {revision!r}; `git log` lists the commits") from None

    def check_out(self, commit: str) -> None:
        self._git(self.tree, "checkout", "--quiet", "--force", "--detach", commit)
        self._git(self.tree, "clean", "--quiet", "-xffd")

    def between(self, good: str, bad: str) -> int:
        """How many commits come after the good one, up to the bad one."""
        return int(self._git(self.tree, "rev-list", "--count", f"{good}..{bad}"))

    def begin(self, good: str, bad: str) -> "str | Narrowed":
        """The commit to try first, checked out."""
        return self._next(self._git(self.tree, "bisect", "start", bad, good, accept=(0, 2)))

    def mark(self, mark: Mark) -> "str | Narrowed":
        """What becomes of the commit that was tried; the one to try next, checked out, or what has come out."""
        return self._next(self._git(self.tree, "bisect", mark, accept=(0, 2)))

    def _next(self, said: str) -> "str | Narrowed":
        if first := _FIRST_BAD.search(said):
            return Narrowed((first[1],))
        if "could be any of" in said:
            return Narrowed(tuple(_HASH_LINE.findall(said)))
        self._git(self.tree, "clean", "--quiet", "-xffd")
        return self._git(self.tree, "rev-parse", "HEAD").strip()

    def commit(self, commit: str) -> Commit:
        form = "--format=%H%x00%as%x00%an%x00%s%x00"
        said = self._git(self.tree, "show", "--no-patch", form, commit)
        parts = said.split("\0")
        names = self._git(self.tree, "diff-tree", "--no-commit-id", "--name-only", "-r", "-m", "--root", commit)
        return Commit(parts[0].strip(), parts[1], parts[2], parts[3], tuple(dict.fromkeys(names.splitlines())))

    def _git(self, where: Path, *arguments: str, accept: tuple[int, ...] = (0,)) -> str:
        environment = {key: value for key, value in os.environ.items() if key not in _FOREIGN} | _ENVIRONMENT
        try:
            ended = subprocess.run(
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
        if ended.returncode not in accept:
            said = " ".join((ended.stderr.strip() or ended.stdout.strip()).split())
            if "not a git repository" in said:
                raise RepositoryError(f"{where}: not in a git repository; name one with --repository")
            raise RepositoryError(f"{where}: git {arguments[0]}: {said[:300] or f'ended with {ended.returncode}'}")
        return ended.stdout + (ended.stderr if arguments[0] == "bisect" else "")
