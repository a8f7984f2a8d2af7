"""Simulate two weeks of nightly runs with planted regressions: `python -m benchmarks.nights`.

A clone of this repository gets two or three commits a day. Most of them change no behaviour. On some days, one of the
commits plants a regression, and a commit on the next day reverts it. Each night plays a matrix in virtual time with the
code of its day, and compares it with the baseline as the nightly workflow does. The result has one row for each night:
the planted regression, the report of the night, and the named commit. Three regressions affect the timing. Two of these
are in the core, so the check of steps finds them too. The third is in the simulated network, where only figures and
changed runs can show it.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).parents[1]
MATRIX = {
    "name": "Nightly",
    "scenario": {"duration_s": 600, "events": {"source": "random", "mean_s": 10}, "vehicles": {"kind": "none"}},
    "loss": [0.0, 0.15, 0.3],
}


@dataclass(frozen=True)
class Plant:
    """A regression: the file, the text in it, and the wrong text."""

    subject: str
    file: str
    right: str
    wrong: str


PLANTS = {
    3: Plant(
        "Ask for one more approval",
        "ucp/commit.py",
        'core.vote_count["yes"] > core.vote_count["no"]',
        'core.vote_count["yes"] > core.vote_count["no"] + 1',
    ),
    5: Plant(
        "Timing: vote for half as long again",
        "ucp/commit.py",
        "core.start(core.voting_timer, core.settings.vote_timeout_s)",
        "core.start(core.voting_timer, core.settings.vote_timeout_s * 1.5)",
    ),
    7: Plant("Pop a block at a tie", "ucp/reconcile.py", "if yes < no or (", "if yes <= no or ("),
    9: Plant(
        "Timing: deliver messages after up to 0.8 s",
        "netem/medium.py",
        "LATENCY = Delay(mean_s=0.026, jitter_s=0.024)",
        "LATENCY = Delay(mean_s=0.41, jitter_s=0.39)",
    ),
    10: Plant(
        "Ignore commits while a block waits",
        "ucp/commit.py",
        '    if core.reconcile_in_progress:\n        return "reconcile in progress"\n    if message.chain_hash != next',
        '    if core.reconcile_in_progress or core.blocks_to_be_committed:\n        return "reconcile in progress"\n'
        "    if message.chain_hash != next",
    ),
    12: Plant(
        "Timing: wait three times as long in phase 2",
        "ucp/reconcile.py",
        "core.start(core.phase_two_timer, core.settings.phase2_timeout_s)",
        "core.start(core.phase_two_timer, core.settings.phase2_timeout_s * 3)",
    ),
    14: Plant(
        "Send requested blocks only from chains of even length",
        "ucp/reconcile.py",
        "    block = core.chain.get(message.block_hash)\n    if block is None:",
        "    block = core.chain.get(message.block_hash)\n    if block is None or len(core.chain) % 2:",
    ),
}
"""The regression that is committed on the day before a night, by the number of the night."""


class Project:
    """The clone and its commits."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        subprocess.run(["git", "clone", "--quiet", "--", ROOT, directory], check=True)

    def git(self, *arguments: str) -> str:
        who = ["-c", "user.name=A developer", "-c", "user.email=developer@example.org"]
        command = ["git", *who, *arguments]
        return subprocess.run(command, cwd=self.directory, capture_output=True, text=True, check=True).stdout.strip()

    def commit_harmless(self, night: int, number: int) -> None:
        """Commit a comment in a file of the core, the documentation or the harness."""
        path = self.directory / ("ucp/reconcile.py", "README.md", "harness/play/mission.py")[(night + number) % 3]
        path.write_text(f"{path.read_text(encoding='utf-8')}\n# Night {night}, change {number}.\n", encoding="utf-8")
        self.git("commit", "--quiet", "--all", "--message", f"Add a comment ({night}.{number})")

    def plant(self, plant: Plant) -> str:
        """Commit the regression, and return the hash of the commit."""
        path = self.directory / plant.file
        text = path.read_text(encoding="utf-8")
        assert text.count(plant.right) == 1, plant
        path.write_text(text.replace(plant.right, plant.wrong), encoding="utf-8")
        self.git("commit", "--quiet", "--all", "--message", plant.subject)
        return self.git("rev-parse", "HEAD")


def play(project: Project, work: Path, night: int, seeds: int, bisect: str) -> dict[str, Any]:
    """Play one night, and return its matrix.json."""
    (work / "nightly.yaml").write_text(json.dumps(MATRIX | {"seeds": seeds}))
    out, baseline = work / f"out-{night}", work / "baseline.json"
    against = ["--against", str(baseline), "--bisect", bisect] if baseline.exists() else []
    subprocess.run(
        [
            sys.executable,
            "-P",
            "-m",
            "harness.cli",
            "matrix",
            "nightly.yaml",
            "--out",
            out,
            "--nights",
            "nights",
            *against,
        ],
        cwd=work,
        env={**os.environ, "PYTHONPATH": str(project.directory)},
        stdout=subprocess.DEVNULL,
        check=False,
    )
    record: dict[str, Any] = json.loads((out / "matrix.json").read_text())
    if not any(change["worse"] for change in (record["against"] or {"changes": []})["changes"]):
        shutil.copy(out / "matrix.json", baseline)
    return record


def reported(record: dict[str, Any], planted: str | None) -> list[str]:
    """Return the cells of a table row: worse figures, changed runs, violations, first handler and named commits."""
    against = record["against"] or {"changes": [], "changed_runs": [], "culprits": []}
    worse = sorted({change["metric"] for change in against["changes"] if change["worse"]})
    changed = sum(len(each["seeds"]) for each in against["changed_runs"])
    pairs = len(record["results"])
    violated = len(
        {(cell["loss"], seed) for cell in record["cells"] for key in cell["violated"].values() for seed in key}
    )
    handlers = [each["handler"] for cell in against["changed_runs"] for each in cell["first"] if each["handler"]]
    first = max(set(handlers), key=handlers.count) if handlers else ""
    named = {commit["hash"] for culprit in against["culprits"] for commit in culprit["commits"]}
    verdict = "" if not named else "the planted one" if named == {planted} else f"{len(named)} commits"
    return [", ".join(worse), f"{changed} of {pairs}" if changed else "", str(violated or ""), first, verdict]


def print_row(fields: list[str]) -> None:
    sys.stdout.write(f"| {' | '.join(fields)} |\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nights", type=int, default=14)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--bisect", default="5m", help="Time for the search of commits in each night.")
    arguments = parser.parse_args()
    print_row(["night", "planted", "worse figures", "changed runs", "violations", "first changed handler", "named"])
    print_row(["--:", "---", "---", "---", "---", "---", "---"])
    with TemporaryDirectory(prefix="ucp-nights-") as directory:
        work = Path(directory)
        project, last = Project(work / "project"), ""
        for night in range(1, arguments.nights + 1):
            if last:
                project.git("revert", "--no-edit", last)
            project.commit_harmless(night, 1)
            plant = PLANTS.get(night)
            last = project.plant(plant) if plant else ""
            project.commit_harmless(night, 2)
            record = play(project, work, night, arguments.seeds, arguments.bisect)
            subject = plant.subject if plant else ""
            print_row([str(night), subject, *reported(record, last or None)])


if __name__ == "__main__":
    main()
