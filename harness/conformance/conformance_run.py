"""A whole run over UDP: the vectors by tours, then what is suspected alone; and what is to be kept of each failure."""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from harness.conformance import _udp_subject
from harness.conformance import _virtual_subject as virtual
from harness.conformance._blame import Evidence
from harness.conformance._handwritten import by_hand
from harness.conformance._kept_failures import keep
from harness.conformance._suite import (
    ALONE_AT_ONCE,
    FAILURES_OF_A_KIND,
    MOST_SUSPICIONS,
    SIDE_BY_SIDE,
    Failure,
    Suite,
    Tally,
)
from harness.conformance._udp_lab import Air
from harness.conformance.results import FURTHER_CHECKS, Case, Results, Row
from harness.conformance.vectors import Vectors, generate
from harness.errors import MachineError

IN_VIRTUAL_TIME = 2
"""Processes of the agent there."""
LIMIT_S = 600.0
"""Of the tours, in wall time; what has not been seen by then is not tried. A quiet machine needs a sixth of it."""


@dataclass(frozen=True)
class Asked:
    """What is to be tested: `only` names one Algorithm, `keep` is where failures are written to."""

    command: tuple[str, ...]
    only: str | None
    keep: Path | None
    virtual: bool = False
    by_hand: bool = True
    enough: int = MOST_SUSPICIONS
    limit_s: float = LIMIT_S


def conform(
    asked: Asked, place: Path, told: Callable[[int, int], None], generated: Sequence[Vectors] | None = None
) -> Results:
    """Raises MachineError, NoAgentError. `told` is called with how many vectors have passed, of how many.

    `generated` are other vectors than all that `asked` is about.
    """
    results = Results(asked.command, 0.0, datetime.now(UTC).isoformat(timespec="seconds"))
    began = time.monotonic()
    try:
        chosen = generate(asked.only) if generated is None else generated
        total = sum(len(vectors.wanted) for vectors in chosen)
        asyncio.run(_run(asked, place, chosen, lambda count: told(count, total), results))
    except KeyboardInterrupt:
        results.interrupted = True
    _keep_failures(results, asked)
    results.wall_s = time.monotonic() - began
    return results


async def _run(
    asked: Asked, place: Path, generated: Sequence[Vectors], told: Callable[[int], None], results: Results
) -> None:
    until = time.monotonic() + asked.limit_s
    if asked.virtual:
        start, programs = virtual.starting(asked.command, place / "errors.log")
        try:
            await _play(Suite(start, generated, told, side_by_side=IN_VIRTUAL_TIME), until, asked, results)
        finally:
            for program in programs:
                await program.close()
        return
    async with Air(place, asked.command, SIDE_BY_SIDE + ALONE_AT_ONCE) as air:
        start = _udp_subject.starting(air)
        await _play(
            Suite(start, generated, told, side_by_side=SIDE_BY_SIDE, enough=asked.enough), until, asked, results
        )
        if asked.by_hand:
            results.cases += await by_hand(air, asked.only)


async def _play(suite: Suite, until: float, asked: Asked, results: Results) -> None:
    try:
        await suite.run(until)
    finally:
        _conclude(suite.tallies, asked, results)


def _conclude(tallies: Sequence[Tally], asked: Asked, results: Results) -> None:
    evidence = Evidence(tallies)
    for tally in tallies:
        failed = {failure.seen.pair for failure in tally.failures}
        for pair, step in tally.vectors.wanted.items():
            algorithm = step.outcome.algorithm
            row = results.counted.setdefault(algorithm, Row(algorithm))
            if pair in tally.passed:
                row.passed += 1
            elif tally.unsupported is not None:
                row.not_applicable += 1
            elif pair not in failed:
                row.not_tried += 1
        if tally.unsupported is not None:
            features = ", ".join(tally.vectors.variant.features) or "the base"
            results.notes.append(f"not supported: {features}: {tally.unsupported}")
        results.cases += [_case(failure, evidence) for failure in tally.failures]
        if tally.set_aside:
            results.notes.append(
                f"{tally.set_aside} vectors were not run, because their branches had failed {FAILURES_OF_A_KIND} times"
            )


def _case(failure: Failure, evidence: Evidence) -> Case:
    seen = failure.seen
    if failure.unexplained_end is not None:
        return Case(
            f"{failure.unexplained_end}; its incarnation had {len(failure.way)} inputs",
            FURTHER_CHECKS,
            "failed",
            reason=failure.unexplained_end,
            settings=failure.variant,
            inputs=failure.way,
            expected=seen.expected,
            came=seen.came,
            wrong=(failure.unexplained_end, "no short sequence that ends with the same input has this effect"),
            exchanges=failure.exchanges,
        )
    blamed = evidence.blame(failure)
    return Case(
        f"{seen.before.text}; {seen.given}",
        blamed.algorithm,
        "failed",
        blamed.handler,
        blamed.branch,
        seen.wrong[0],
        failure.variant,
        failure.way,
        seen.expected,
        seen.came,
        seen.wrong,
        failure.exchanges,
    )


def _keep_failures(results: Results, asked: Asked) -> None:
    """Write the files of each failure. If the disk refuses one, a note reports this, and the results stay."""
    if asked.keep is None:
        return
    kept = []
    try:
        for number, case in enumerate(results.cases, 1):
            if case.verdict == "failed":
                place = asked.keep / f"{number:02d}-{case.handler or 'program'}"
                keep(case, asked.command, place)
                case = replace(case, directory=str(place))
            kept.append(case)
    except MachineError as error:
        results.notes.append(str(error))
    results.cases[: len(kept)] = kept
