"""Combine all checks of a run into one verdict: six characteristics, three further checks, and the numeric results.

`stored_differences` compares the verdict in run.json with a new verdict on the files of the run. The same version of
the checker gives the same verdict on the same files. A difference then means that a file was edited after the run. A
different version of the checker may also give a different verdict.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from harness.archive.archive import RunArchive
from harness.archive.run_record import RunRecord, Survival
from harness.checker import (
    _all_committed,
    _distributed,
    _genuine,
    _idle_committed,
    _liveness,
    _single_copy,
    records,
    steps,
    uniform_chain,
)
from harness.checker._liveness import figures
from harness.checker.evidence import Evidence, gather
from harness.checker.judgement import Judgement
from harness.checker.records import cross_examine, in_doubt
from harness.errors import INCOMPLETE, VIOLATED
from harness.scenario.verdict_names import ALL_CHECKS, CHARACTERISTICS, UNFINISHED

CHECKS = {
    "1": _distributed.check,
    "2": _idle_committed.check,
    "3": _single_copy.check,
    "4": _genuine.check,
    "5": _all_committed.check,
    "6": uniform_chain.check,
}

FURTHER_CHECKS: dict[str, Callable[[Evidence], Judgement]] = {
    "steps": steps.check,
    "records": records.check,
    "liveness": _liveness.check,
}
"""The checks of properties that the thesis does not list as characteristics: the key of each check, and its function.
`harness.scenario.verdict_names` defines the keys.
"""


@dataclass(frozen=True)
class Result:
    """The complete verdict on a run."""

    characteristics: dict[str, Judgement]
    """The judgement of each characteristic. The key is its number, "1" to "6"."""
    figures: dict[str, float | int | None]
    """The numeric results by name, as in run.json. A value of None is unknown."""
    beside: dict[str, Judgement] = field(default_factory=dict)
    """The judgements of the three further checks. Their keys are `steps`, `records` and `liveness`."""
    errors: list[str] = field(default_factory=list)
    """One sentence for each file that could not be read completely."""
    chains: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Agent ID -> block hashes of its chain in hexadecimal, oldest first."""
    top_chain_hashes: dict[int, str] = field(default_factory=dict)
    """Agent ID -> top chain hash in hexadecimal. This hash identifies the agent's whole chain."""

    @property
    def judgements(self) -> dict[str, Judgement]:
        """All judgements in the order in which the report shows them. The key is the number of a characteristic or the
        name of another check.
        """
        return {**self.characteristics, **self.beside}

    @property
    def bad(self) -> tuple[str, ...]:
        """The keys of the checks with a bad verdict: numbers of characteristics, and names of other checks."""
        return tuple(key for key, judgement in self.judgements.items() if judgement.kind == "bad")

    @property
    def wrong(self) -> tuple[str, ...]:
        """The keys of the checks with a bad verdict, without `liveness` if the swarm may only need more time."""
        return tuple(key for key in self.bad if self.judgements[key].verdict != UNFINISHED)

    @property
    def exit_status(self) -> int:
        """The exit status of the command: 0 without violations, 1 after a violation, 4 if the swarm only needs more
        time.
        """
        return VIOLATED if self.wrong else INCOMPLETE if self.bad else 0

    def to_json(self) -> dict[str, object]:
        """Return the verdict as JSON, in the form of the schema `ucp-run/1`: one key for each part of the verdict."""
        return {
            "characteristics": {
                number: characteristic.to_json() for number, characteristic in self.characteristics.items()
            },
            **{key: judgement.to_json() for key, judgement in self.beside.items()},
            "figures": self.figures,
            "errors": self.errors,
        }


def check(run: Evidence | RunArchive) -> Result:
    """Judge the six characteristics (Section 4.3), all steps of agents, the agreement of the records, and liveness.

    `run` is an archive, or the evidence from it. A damaged file raises no error. `Result.errors` then contains a
    sentence about it.
    """
    evidence = gather(run) if isinstance(run, RunArchive) else run
    chains = {agent_id: export.chain_of_block_hashes for agent_id, export in evidence.exports.items()}
    tops = {agent_id: export.top_chain_hash for agent_id, export in evidence.exports.items()}
    if evidence.record is not None and evidence.record.outcome == "not supported":
        reason = evidence.record.outcome_detail or "not supported by an agent"
        unjudged = {key: Judgement(name, "not applicable", reason) for key, name in ALL_CHECKS.items()}
        beside = {key: unjudged.pop(key) for key in FURTHER_CHECKS}
        return Result(unjudged, figures(evidence), beside, evidence.errors, chains, tops)
    return Result(
        {number: in_doubt(number, judge(evidence), evidence.cached(cross_examine)) for number, judge in CHECKS.items()},
        figures(evidence),
        {key: judge(evidence) for key, judge in FURTHER_CHECKS.items()},
        evidence.errors,
        chains,
        tops,
    )


def stored_differences(record: RunRecord, result: Result, survived: Survival) -> Iterator[str]:
    """Yield a sentence for each verdict or numeric result in run.json that differs from the new one. Yield nothing if
    run.json contains no verdict.
    """
    if not record.characteristics:
        return
    for key, judgement in result.judgements.items():
        stored = record.judgements.get(key)
        if stored is not None and stored.verdict != judgement.verdict:
            name = f"characteristic {key}" if key in CHARACTERISTICS else f"`{ALL_CHECKS[key]}`"
            yield f"run.json has {stored.verdict!r} for {name}, but its files give {judgement.verdict!r}"
    for name, figure in result.figures.items():
        if name in record.figures and record.figures[name] != figure:
            yield f"run.json has {record.figures[name]} as figure {name}, but its files give {figure}"
    if record.survival is not None and record.survival != survived:
        yield "run.json has another survival of blocks than its files give"
