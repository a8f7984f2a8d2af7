"""Run the same proof for the original agent core, to find the violations that a modified core adds.

`prove` reports all violations, and the published protocol itself has some. After a change of the core, only the new
violations are relevant. The original is the `ucp` of a commit or of a second checkout. A separate process explores the
original core with the installed prover, so both proofs check the same properties. The process receives its bounds on
standard input and prints the result as JSON:

    python -m harness.proof.original
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import INCOMPLETE, INTERRUPTED, VIOLATED, HarnessError
from harness.play.core_version import CORE, edited_files
from harness.proof._proof import Limits, Proof, prove
from harness.proof._proof_text import in_words
from harness.proof.bounds import Bounds
from harness.run.code_state import ROOT, GitBisection, run_python

MODULE = "harness.proof.original"
INSTALLED = "installed"
"""The name that a user gives for the agent core of this installation without a variant."""
EXIT_S = 60.0
"""Seconds that the process may take in addition to the time limit, to start and to write its result."""


class OriginalError(HarnessError):
    """An error: the original agent core cannot be found or explored."""


@dataclass(frozen=True)
class OriginalProof:
    """The proof of the original agent core. `findings` contains a sentence for each violation by key. `lines` is the
    printed result.
    """

    name: str
    findings: dict[str, str]
    complete: bool
    lines: list[str]


@dataclass(frozen=True)
class ProofComparison:
    """A proof of the installed agent core, compared with a proof of the original core."""

    proof: Proof
    original: OriginalProof

    @property
    def new(self) -> dict[str, str]:
        """The violations of the installed agent core that the original core does not have."""
        return {key: text for key, text in self.proof.findings.items() if key not in self.original.findings}

    @property
    def shared(self) -> dict[str, str]:
        """The violations that both the installed core and the original core have."""
        return {key: text for key, text in self.proof.findings.items() if key in self.original.findings}

    @property
    def exit_status(self) -> int:
        if self.new:
            return VIOLATED
        if self.proof.exit_status == INTERRUPTED:
            return INTERRUPTED
        return 0 if self.proof.decided else INCOMPLETE

    def to_json(self) -> dict[str, object]:
        original = {"name": self.original.name, "complete": self.original.complete, "findings": self.original.findings}
        return {**self.proof.to_json(), "original": original, "new_findings": self.new, "shared_findings": self.shared}

    def in_words(self) -> Iterator[str]:
        yield from in_words(self.proof)
        yield ""
        yield f"the original, {self.original.name}:"
        yield from (f"  {line}" for line in self.original.lines)
        yield ""
        for text in self.shared.values():
            yield f"- the original has it as well: {text}"
        for text in self.new.values():
            yield f"✘ new: {text}"
        if not self.original.complete:
            yield "- the proof of the original is not complete: a finding that counts as new can be an old one"
        if not self.new and not self.proof.decided:
            yield "- not decided: the search ended early, so a new violation is possible in the states beyond"
        elif not self.new:
            yield "✔ no finding is new"


@contextmanager
def code_of(original: str) -> Iterator[Path]:
    """Yield a directory with the code of the agent core that `original` names.

    There are three possible values of `original`:

    - "installed": the core of this installation. A proof with a variant uses this value.
    - a directory that contains `ucp/`
    - a commit of this clone

    Raises OriginalError, or RepositoryError for an unknown commit.
    """
    if original == INSTALLED:
        yield CORE.parent
        return
    directory = Path(original)
    if directory.is_dir():
        if not (directory / "ucp" / "agent.py").is_file():
            raise OriginalError(f"--against {original}: the directory has no ucp/agent.py; name the top of a checkout")
        yield directory.resolve()
        return
    if not (ROOT / ".git").exists():
        raise OriginalError(f"--against {original}: no such directory, and the harness does not run from a git clone")
    with TemporaryDirectory(prefix="ucp-original-") as name:
        history = GitBisection.clone(ROOT, Path(name) / "code")
        history.check_out(history.resolve(original))
        yield history.tree


def prove_original(name: str, code: Path, bounds: Bounds, limits: Limits) -> OriginalProof:
    """Run the proof for the agent core in the directory `code`, with the same bounds and limits. Raises OriginalError
    if the process fails.
    """
    with TemporaryDirectory(prefix="ucp-original-") as temporary:
        place = Path(temporary)
        (place / "core").mkdir()
        (place / "core" / "ucp").symlink_to(code / "ucp", target_is_directory=True)
        most_s = None if limits.most_s == float("inf") else limits.most_s
        asked = {"bounds": asdict(bounds), "limits": [limits.most_bytes, most_s, limits.cores]}
        ended = run_python(
            ["-m", MODULE],
            first=[place / "core", ROOT],
            cwd=place,
            limit_s=None if most_s is None else 2 * most_s + EXIT_S,
            stdin=json.dumps(asked),
        )
        try:
            found = json.loads(ended.stdout)
            return OriginalProof(name, found["findings"], found["complete"], found["lines"])
        except (ValueError, KeyError, TypeError):
            raise OriginalError(
                f"--against {name}: the prover cannot explore this core: {ended.last_error_line}"
            ) from None


def is_edited(code: Path) -> bool:
    """Return true if the agent core in the directory `code` differs from the released one."""
    return bool(edited_files(code / "ucp"))


def main() -> None:
    """Explore the agent core that this process imports, and print the result."""
    asked = json.load(sys.stdin)
    most_bytes, most_s, cores = asked["limits"]
    bounds = Bounds(**{**asked["bounds"], "faults": tuple(asked["bounds"]["faults"])})
    limits = Limits(most_bytes, float("inf") if most_s is None else most_s, cores)
    proof = prove(bounds, limits, Path("original.yaml"))
    lines = [line for line in in_words(proof) if "ucp-harness run" not in line and "played: " not in line]
    json.dump({"findings": proof.findings, "complete": proof.decided, "lines": lines}, sys.stdout)
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
