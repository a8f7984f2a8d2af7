"""Compare the proofs of wrong agents with and without state reductions: `python -m benchmarks.reductions [NAME]...`.

Each bug of `tests/harness/proof/planted_bugs.py` is planted into a copy of `ucp/`. A process with this core runs the
proof within the bounds of the bug three times: with the default options, with `--whole`, and with reductions although
the core is edited. The first two must have the same findings. The third shows why the prover reduces no states of an
edited core: with reductions, it can miss a violation, or report a violation that no run shows. NAME is a part of the
name of a bug.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from harness.errors import HarnessError
from harness.proof import Bounds, Limits, prove
from tests.harness.proof.edited_core import edited, environment
from tests.harness.proof.planted_bugs import BUGS, PlantedBug

LIMIT_S = 120.0
"""Time limit of a proof in seconds."""


def findings(bug: PlantedBug, kinds: Sequence[str] = ("default", "whole", "forced")) -> dict[str, list[str]]:
    """Prove the bug in up to three ways: by default, with `--whole`, and with forced reductions. Return the kinds of
    findings of each proof.

    The finding is "refused" if the prover refuses the agent, and "not decided" if a proof has no result.
    """
    with TemporaryDirectory(prefix="ucp-reductions-") as name:
        core = edited(Path(name), *bug.edits)
        done = subprocess.run(
            [sys.executable, "-P", "-m", "benchmarks.reductions", "--child"],
            cwd=name,
            env=environment(core),
            input=json.dumps([asdict(bug.bounds), list(kinds)]),
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise RuntimeError(f"{bug.name}: {done.stderr[-900:]}")
    results: dict[str, list[str]] = json.loads(done.stdout)
    return results


def _child() -> None:
    """Prove within the bounds on standard input with the agent core of this process."""
    document, kinds = json.load(sys.stdin)
    bounds = Bounds(**{**document, "faults": tuple(document["faults"])})
    json.dump({kind: _findings(bounds, kind) for kind in kinds}, sys.stdout)


def _findings(bounds: Bounds, kind: str) -> list[str]:
    bounds = replace(bounds, reduced=kind != "whole")
    allowed = patch.object(Bounds, "why_not_reduced", lambda self: None) if kind == "forced" else nullcontext()
    try:
        with allowed:
            proof = prove(bounds, Limits(most_s=LIMIT_S), Path(f"{kind}.yaml"))
    except HarnessError:
        return ["refused"]
    except RuntimeError:
        if kind == "forced":  # no reduction is made for such an agent
            return ["refused"]
        raise
    assert proof.bounds.reduced == (kind == "forced")
    found = dict.fromkeys("one chain" if key == "one chain" else key.split()[0] for key in proof.findings)
    return [*found] or ([] if proof.decided else ["not decided"])


def main() -> int:
    if sys.argv[1:] == ["--child"]:
        _child()
        return 0
    chosen = [bug for bug in BUGS if not sys.argv[1:] or any(part in bug.name for part in sys.argv[1:])]
    differ = 0
    for bug in chosen:
        began_s = time.monotonic()
        found = findings(bug)
        same = found["default"] == found["whole"] == [*bug.findings]
        differ += not same
        words = "; ".join(f"{kind}: {', '.join(kinds) or 'holds'}" for kind, kinds in found.items())
        seconds = time.monotonic() - began_s
        sys.stdout.write(f"{'✔' if same else '✘'} {bug.name} ({bug.bounds.in_words()}, {seconds:.0f} s): {words}\n")
        sys.stdout.flush()
    return 1 if differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
