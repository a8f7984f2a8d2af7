"""Search for new findings for one night.

First, the scenarios of known findings are run again. Then the search continues from the stored runs until the time is
over. New coverage and new findings are written immediately. An interruption therefore only loses the current runs.
"""

import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Literal

from harness.errors import INTERRUPTED, VIOLATED, HarnessError
from harness.proof import Bounds
from harness.proof.coverage import ExistingStates, existing
from harness.proof.coverage import to_json as coverage_to_json
from harness.run.parallel import sweep
from harness.run.provenance import versions
from harness.run.simulate import check_determinism, evidence_lines, simulated
from harness.scenario import Scenario
from harness.sweep.explore._exploring import smallest_of
from harness.sweep.explore._recording import record
from harness.sweep.explore._scenario_document import Document
from harness.sweep.explore._smaller import file_of, scenario_of
from harness.sweep.explore.guided._corpus import Corpus, Finding, opened
from harness.sweep.explore.guided._hunt import CandidateRun, Hunt
from harness.sweep.explore.guided._hunt_trial import (
    FindingIdentity,
    findings_of,
    initial_documents,
    with_liveness_phase,
)
from harness.sweep.explore.guided._mutation import MutationLimits
from harness.sweep.explore.guided._night_page import to_html

Status = Literal["new", "resolved", "rare", "ongoing"]

SCHEMA = "ucp-exploration/1"
INITIAL_RUNS = 4
"""Number of runs of the scenario from which the first documents are created."""
SEEDS = 20
"""Number of seeds with which the scenario of a finding is run, to measure how often the finding occurs."""
RARE = 0.5
"""Share of the seeds (0 to 1). A finding that occurs with a smaller share of the seeds counts as rare."""
SHRINKING_RUNS = 400
MOST_AGENTS, MOST_BLOCKS = 3, 3
"""The numbers of agents and blocks of a proof. The coverage of the search is compared with the states of this proof."""
SAMPLES = 200


@dataclass(frozen=True)
class NightProgress:
    """Functions that show the progress to the user."""

    on_progress: Callable[[int, int, int], None] = lambda runs, states, findings: None
    """A function that receives the numbers of runs, agent states and findings so far."""
    on_event: Callable[[str], None] = lambda words: None
    """A function that receives a text about an event of the search, such as a new finding."""


@dataclass
class NightFinding:
    """A finding, with the status that it has in this night."""

    finding: Finding
    status: Status
    shown: int
    """Number of seeds with which the finding occurred."""
    of: int
    """Number of seeds with which the scenario of the finding was run."""
    path: Path | None

    @property
    def replay(self) -> str | None:
        """The command that runs the scenario of the finding again. None if there is no such command."""
        return None if self.path is None else f"ucp-harness run {self.path} --backend sim --seed {self.finding.seed}"

    def to_json(self) -> dict[str, object]:
        return {
            "status": self.status,
            **self.finding.model_dump(),
            "in_words": str(self.finding.identity),
            "shown": self.shown,
            "of": self.of,
            "scenario": None if self.path is None else str(self.path),
            "replay": self.replay,
        }


@dataclass
class NightResult:
    """The results of a night."""

    scenario: Scenario
    directory: Path
    hunt: Hunt
    started_at: str
    findings: list[NightFinding] = field(default_factory=list)
    growth: list[tuple[int, int]] = field(default_factory=list)
    """The growth of the coverage. Each entry is a pair: a number of runs, and the number of agent states that were
    known after these runs.
    """
    interrupted: bool = False
    seconds: float = 0.0
    processor_s: float = 0.0
    left_out: list[str] = field(default_factory=list)
    existing_states: ExistingStates | None = None
    report: Path | None = None

    def grow(self) -> None:
        """Add an entry to `growth`. In a long night, only every second, fourth or eighth entry is kept."""
        self.growth.append((self.hunt.runs, self.hunt.local_states))
        if len(self.growth) > 2 * SAMPLES:
            del self.growth[1::2]

    @property
    def exit_status(self) -> int:
        if self.interrupted:
            return INTERRUPTED
        return VIOLATED if self.hunt.failed or any(finding.status != "resolved" for finding in self.findings) else 0

    def to_json(self) -> dict[str, object]:
        reached = self.hunt.reached
        return {
            "schema": SCHEMA,
            "scenario": self.scenario.name,
            "started_at": self.started_at,
            "outcome": "interrupted" if self.interrupted else "completed",
            "seconds": round(self.seconds, 1),
            "processor_s": round(self.processor_s, 1),
            "runs": self.hunt.runs,
            "kept": len(self.hunt.kept),
            "local_states": self.hunt.local_states,
            "pairs": self.hunt.pairs,
            "coverage": coverage_to_json(reached, self.existing_states),
            "growth": [list(sample) for sample in self.growth],
            "findings": [finding.to_json() for finding in self.findings],
            "failed": [{"seed": candidate.seed, "reason": reason} for candidate, reason in self.hunt.failed],
            "failures": self.hunt.failures,
            "unfinished": self.hunt.unfinished,
            "left_out": self.left_out[:SAMPLES],
            "versions": versions(),
        }


def spend(
    scenario: Scenario,
    directory: Path,
    *,
    first_seed: int = 0,
    for_s: float = float("inf"),
    most_runs: float = float("inf"),
    jobs: int = 1,
    watcher: NightProgress = NightProgress(),
) -> NightResult:
    """Search for `for_s` seconds or `most_runs` runs, and store the results in `directory`. Ctrl-C ends the night
    early.

    Raises HarnessError if the scenario cannot be played, or if the directory cannot be used.
    """
    if scenario.foreign:
        check_determinism(scenario, first_seed)
    limits, initial = initial_documents(scenario, range(first_seed, first_seed + INITIAL_RUNS))
    corpus = opened(directory, scenario, limits)
    try:
        return _NightRun(scenario, corpus, limits, first_seed, for_s, most_runs, jobs, watcher).spend(
            [CandidateRun(*each) for each in initial]
        )
    finally:
        corpus.close()


class _NightRun:
    """The execution of the search in one night."""

    def __init__(
        self,
        scenario: Scenario,
        corpus: Corpus,
        limits: MutationLimits,
        first_seed: int,
        for_s: float,
        most_runs: float,
        jobs: int,
        watcher: NightProgress,
    ) -> None:
        self._corpus, self._jobs, self._watcher = corpus, jobs, watcher
        self._most_runs = most_runs
        self._start_s, self._start_processor_s = time.monotonic(), _processor_s()
        self._ends_s = self._start_s + for_s
        started_at = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        self._night = NightResult(scenario, corpus.directory, Hunt(limits, Random(f"{first_seed}")), started_at)
        self._known = {finding.identity: finding for finding in corpus.findings()}
        self._new: dict[FindingIdentity, Finding] = {}
        self._shown: dict[FindingIdentity, tuple[int, int]] = {}

    def spend(self, initial: list[CandidateRun]) -> NightResult:
        night = self._night
        try:
            self._replay()
            self._hunt(initial)
            self._shrink()
            bounds = Bounds(min(len(night.hunt.limits.roster), MOST_AGENTS), min(night.hunt.limits.blocks, MOST_BLOCKS))
            night.existing_states = existing(bounds)
        except KeyboardInterrupt:
            night.interrupted = True
        self._finish()
        return night

    def _replay(self) -> None:
        """Run the scenarios of known findings again, and count the seeds with which each finding occurs."""
        for identity, finding in self._known.items():
            document = self._corpus.scenario_of(finding)
            if document is None:
                self._corpus.left_out.append(f"{finding.file}: nothing shows {identity} again")
            else:
                self._watcher.on_event(f"playing a known finding again: {identity}")
                self._shown[identity] = self._count_seeds(identity, document, finding.seed)

    def _count_seeds(self, identity: FindingIdentity, document: Document, seed: int) -> tuple[int, int]:
        seeds = [seed, *(other for other in range(1, SEEDS + 1) if other != seed)][:SEEDS]

        def shows(with_seed: int) -> bool:
            return identity in findings_of(Scenario.model_validate(document), with_seed)

        with sweep(seeds, shows, self._jobs) as outcomes:
            return sum(outcome is True for _, outcome in outcomes), len(seeds)

    def _hunt(self, initial: list[CandidateRun]) -> None:
        """Continue the search from the stored runs.

        If there was enough time to repeat all stored runs, remove the runs that no longer reach new states.
        """
        hunt, before = self._night.hunt, self._corpus.runs()
        kept = set(map(id, self._kept_runs(hunt.begin([*initial, *before], self._jobs))))
        if not hunt.kept:
            reason = hunt.failed[0][1] if hunt.failed else "no run of the scenario can be changed and played"
            raise HarnessError(f"the hunt has no run to start from: {reason}")
        for candidate in () if self._is_over else before:
            if id(candidate) not in kept:
                self._corpus.drop(candidate)
        while not self._is_over:
            for _ in self._kept_runs(hunt.round(self._jobs)):
                pass
            for candidate in hunt.dropped():
                self._corpus.drop(candidate)

    @property
    def _is_over(self) -> bool:
        return time.monotonic() >= self._ends_s or self._night.hunt.runs >= self._most_runs

    def _kept_runs(self, runs: Iterator[tuple[CandidateRun, bool]]) -> Iterator[CandidateRun]:
        """Write each stored run to its file, and then yield the run. Also write each new finding to its file. Stop when
        the night is over.
        """
        night, hunt = self._night, self._night.hunt
        for candidate, is_kept in runs:
            night.grow()
            if is_kept:
                self._corpus.keep(candidate)
                yield candidate
            for identity in hunt.found.keys() - self._known.keys() - self._new.keys():
                self._add_finding(identity, hunt.found[identity])
            self._watcher.on_progress(hunt.runs, hunt.local_states, len(hunt.found))
            if self._is_over:
                return

    def _add_finding(self, identity: FindingIdentity, candidate: CandidateRun) -> None:
        finding = Finding(
            **vars(identity),
            seed=candidate.seed,
            first=self._night.started_at,
            last=self._night.started_at,
        )
        self._new[identity] = finding
        self._write(finding, with_liveness_phase(candidate.document), "as it was found")
        self._watcher.on_event(f"found: {identity}")

    def _write(self, finding: Finding, document: Document, words: str) -> None:
        result = simulated(scenario_of(document), finding.seed)
        lines = evidence_lines({key: result.judgements[key] for key in result.wrong})
        finding.words[:] = [line[:500] for line in lines][:20]
        header = [*lines, f"Found by exploring {self._night.scenario.name!r}, {words}."]
        path = self._corpus.write_scenario(
            finding, file_of(document, header, record(scenario_of(document), finding.seed))
        )
        self._corpus.write_findings([*self._known.values(), *self._new.values()])
        assert path.exists()

    def _shrink(self) -> None:
        """Reduce the scenarios of new findings."""
        for identity, finding in self._new.items():
            document = with_liveness_phase(self._night.hunt.found[identity].document)
            self._watcher.on_event(f"shrinking: {identity}")

            def still(scenario: Scenario, identity: FindingIdentity = identity, seed: int = finding.seed) -> bool:
                return identity in findings_of(scenario, seed)

            smallest, words, interrupted = smallest_of(
                document,
                still,
                lambda document, seed=finding.seed: record(scenario_of(document), seed),  # type: ignore[misc]
                jobs=self._jobs,
                max_runs=SHRINKING_RUNS,
                on_step=lambda runs, words: None,
            )
            self._write(finding, smallest, words)
            if interrupted:
                raise KeyboardInterrupt
            self._shown[identity] = self._count_seeds(identity, smallest, finding.seed)

    def _finish(self) -> None:
        """Determine the status of each finding, and write all results of the night."""
        night, corpus = self._night, self._corpus
        for identity, finding in {**self._known, **self._new}.items():
            shown, of = self._shown.get(identity, (0, 0))
            in_hunt = night.hunt.shown[identity]
            status: Status = "ongoing"
            if identity in self._new:
                status = "new"
            elif of and not shown and not in_hunt and not night.interrupted:
                status = "resolved"
            elif of and shown < RARE * of:
                status = "rare"
            if status != "resolved" and (shown or in_hunt):
                finding.last = night.started_at
            path = corpus.directory / "findings" / finding.file
            night.findings.append(NightFinding(finding, status, shown, of, path if path.exists() else None))
        corpus.write_findings([*self._known.values(), *self._new.values()])
        night.seconds = time.monotonic() - self._start_s
        night.processor_s = _processor_s() - self._start_processor_s
        night.left_out = corpus.left_out
        document = night.to_json()
        night.report = corpus.write_night(night.started_at, document, lambda nights: to_html(document, nights))


def _processor_s() -> float:
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )
