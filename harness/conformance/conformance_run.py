"""Test one agent for conformance: run all generated and handwritten tests, and write files about each failure."""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from harness.conformance import _udp_agent
from harness.conformance import _virtual_agent as virtual
from harness.conformance._blame import BlameEvidence
from harness.conformance._kept_failures import keep
from harness.conformance._reference_model import AGENT
from harness.conformance._suite import (
    MAX_FAILURES_OF_A_KIND,
    MAX_SUSPICIONS,
    MAX_WORKERS,
    RETRY_WORKERS,
    ConfirmedFailure,
    VariantResult,
    VectorSuite,
)
from harness.conformance._udp_lab import UdpLab
from harness.conformance.cases import handwritten
from harness.conformance.results import FURTHER_CHECKS, AlgorithmCounts, CaseResult, ConformanceResults
from harness.conformance.vectors import VectorSet, generate
from harness.errors import MachineError
from harness.play.remote.agent_pool import PLACES, AgentPool

VIRTUAL_WORKERS = 2
"""Number of agent processes in a test in virtual time."""
LIMIT_S = 600.0
"""Time limit of all tours in seconds of wall time. Vectors that remain after this time are not run. An idle machine
needs about 100 s for all vectors.
"""


@dataclass(frozen=True)
class ConformanceRequest:
    """The agent to test, and the options of the test."""

    command: tuple[str, ...]
    only: str | None
    """Number or handler of the only Algorithm to test. None to test all."""
    keep: Path | None
    """Directory for the files about failures. None to write no files."""
    virtual: bool = False
    """True to test in virtual time."""
    handwritten: bool = True
    """True to run the handwritten cases as well. They run over UDP."""
    max_suspicions: int = MAX_SUSPICIONS
    limit_s: float = LIMIT_S
    remote: AgentPool | None = None
    """The agents on another computer, which communicate over UDP. `command` is then empty. None if the agents run here.
    """
    small: bool = False
    """True to apply the profile for small machines."""


def remote_agents(listen: str, secret: bytes) -> AgentPool:
    """Return the agents under test on another computer, which connects at the address `listen`."""
    return AgentPool(AGENT, listen, secret)


def conform(
    request: ConformanceRequest,
    place: Path,
    show_progress: Callable[[int, int], None],
    vector_sets: Sequence[VectorSet] | None = None,
) -> ConformanceResults:
    """Test an agent, and return the results. Raises MachineError, NoAgentError.

    `show_progress` is called with the number of passed vectors and the number of all vectors. If `vector_sets` is
    given, it replaces the vectors that the request selects.
    """
    results = ConformanceResults(request.command, 0.0, datetime.now(UTC).isoformat(timespec="seconds"))
    began = time.monotonic()
    try:
        chosen = generate(request.only) if vector_sets is None else vector_sets
        total = sum(len(vectors.wanted) for vectors in chosen)
        asyncio.run(_run(request, place, chosen, lambda count: show_progress(count, total), results))
    except KeyboardInterrupt:
        results.interrupted = True
    _keep_failures(results, request)
    results.wall_s = time.monotonic() - began
    return results


async def _run(
    request: ConformanceRequest,
    place: Path,
    vector_sets: Sequence[VectorSet],
    show_progress: Callable[[int], None],
    results: ConformanceResults,
) -> None:
    if request.virtual:
        until = time.monotonic() + request.limit_s
        start, programs = virtual.starter(request.command, place / "errors.log")
        try:
            await _play(
                VectorSuite(start, vector_sets, show_progress, workers=VIRTUAL_WORKERS), until, request, results
            )
            if request.only is None:
                results.cases.append(await virtual.case_of_end(programs))
        finally:
            for program in programs:
                program.close()
        return
    if request.remote is None:
        await _play_over_udp(request, place, vector_sets, show_progress, results)
        return
    async with request.remote.opened(place):
        await request.remote.wait()
        results.command = request.remote.command
        results.notes.append(
            f"the agent ran on the computer {request.remote.host}, to which a message took "
            f"{1000 * request.remote.delay_s:.2g} ms"
        )
        playing = asyncio.create_task(_play_over_udp(request, place, vector_sets, show_progress, results))
        watching = asyncio.create_task(request.remote.watch())
        try:
            await asyncio.wait({playing, watching}, return_when=asyncio.FIRST_COMPLETED)
            for task in (watching, playing):
                if task.done():
                    task.result()
        finally:
            for task in (watching, playing):
                task.cancel()
            await asyncio.gather(watching, playing, return_exceptions=True)


async def _play_over_udp(
    request: ConformanceRequest,
    place: Path,
    vector_sets: Sequence[VectorSet],
    show_progress: Callable[[int], None],
    results: ConformanceResults,
) -> None:
    if request.small:
        results.notes.append("the test applied the profile for small machines")
    until = time.monotonic() + request.limit_s
    workers = MAX_WORKERS if request.remote is None else PLACES
    async with UdpLab(place, request.command, MAX_WORKERS + RETRY_WORKERS, request.remote, small=request.small) as lab:
        start = _udp_agent.starter(lab)
        suite = VectorSuite(start, vector_sets, show_progress, workers=workers, max_suspicions=request.max_suspicions)
        await _play(suite, until, request, results)
        if request.handwritten:
            results.cases += await handwritten(lab, request.only)


async def _play(suite: VectorSuite, until: float, request: ConformanceRequest, results: ConformanceResults) -> None:
    try:
        await suite.run(until)
    finally:
        _conclude(suite.variant_results, request, results)


def _conclude(
    variant_results: Sequence[VariantResult], request: ConformanceRequest, results: ConformanceResults
) -> None:
    evidence = BlameEvidence(variant_results)
    for variant_result in variant_results:
        failed = {failure.observation.key for failure in variant_result.failures}
        for key, step in variant_result.vectors.wanted.items():
            algorithm = step.outcome.algorithm
            row = results.counted.setdefault(algorithm, AlgorithmCounts(algorithm))
            if key in variant_result.passed:
                row.passed += 1
            elif variant_result.unsupported is not None:
                row.not_applicable += 1
            elif key not in failed:
                row.not_tried += 1
        if variant_result.unsupported is not None:
            features = ", ".join(variant_result.vectors.variant.features) or "the base"
            results.notes.append(f"not supported: {features}: {variant_result.unsupported}")
        results.cases += [_case(failure, evidence) for failure in variant_result.failures]
        if variant_result.set_aside:
            results.notes.append(
                f"{variant_result.set_aside} vectors were not run, because their branches had failed "
                f"{MAX_FAILURES_OF_A_KIND} times"
            )


def _case(failure: ConfirmedFailure, evidence: BlameEvidence) -> CaseResult:
    observation = failure.observation
    if failure.unexplained_end is not None:
        return CaseResult(
            f"{failure.unexplained_end}; its incarnation had {len(failure.path)} inputs",
            FURTHER_CHECKS,
            "failed",
            reason=failure.unexplained_end,
            settings=failure.variant,
            inputs=failure.path,
            expected=observation.expected,
            received=observation.received,
            wrong=(failure.unexplained_end, "no short sequence that ends with the same input has this effect"),
            exchanges=failure.exchanges,
        )
    blamed = evidence.blame(failure)
    return CaseResult(
        f"{observation.before.text}; {observation.given}",
        blamed.algorithm,
        "failed",
        blamed.handler,
        blamed.branch,
        observation.wrong[0],
        failure.variant,
        failure.path,
        observation.expected,
        observation.received,
        observation.wrong,
        failure.exchanges,
    )


def _keep_failures(results: ConformanceResults, request: ConformanceRequest) -> None:
    """Write the files of each failure. If the disk refuses a file, add a note to the results."""
    if request.keep is None:
        return
    kept = []
    try:
        for number, case in enumerate(results.cases, 1):
            if case.verdict == "failed":
                place = request.keep / f"{number:02d}-{case.handler or 'program'}"
                keep(case, results.command, place)
                case = replace(case, directory=str(place))
            kept.append(case)
    except MachineError as error:
        results.notes.append(str(error))
    results.cases[: len(kept)] = kept
