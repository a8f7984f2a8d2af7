"""Test one agent for conformance: run all generated and handwritten tests, and write files about each failure.

failure.txt       the expected and the received messages
vector.jsonl      the inputs and the expected answers, as `COMMAND --virtual` reads and writes them
scenario.yaml     the same inputs as a scenario, for `ucp-harness run --backend sim`
air.pcapng        the datagrams, for Wireshark and `ucp-harness packets`

The scenario runs in virtual time. Such a run has a report and a trace, and the checker judges each step. If a
timer expired late in the test, the inputs may be impossible in virtual time. In that case failure.txt reports this, and
there are no vector and no scenario.
"""

import asyncio
import base64
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from harness.conformance import _udp_agent
from harness.conformance import _virtual_agent as virtual
from harness.conformance._blame import BlameEvidence
from harness.conformance._observation import RecordedDatagram
from harness.conformance._reference_model import AGENT, INITIAL_DATA, PEERS, ROSTER
from harness.conformance._state_space import VARIANTS, SettingsVariant
from harness.conformance._suite import (
    MAX_FAILURES_OF_A_KIND,
    MAX_SUSPICIONS,
    MAX_WORKERS,
    RETRY_WORKERS,
    ConfirmedFailure,
    VariantResult,
    VectorSuite,
)
from harness.conformance._udp_lab import AGENTS_VEHICLE, PEERS_VEHICLE, UdpLab
from harness.conformance._virtual_agent import LineWriter, NotPlayableError
from harness.conformance.cases import handwritten
from harness.conformance.results import FURTHER_CHECKS, AlgorithmCounts, CaseResult, ConformanceResults
from harness.conformance.results_table import lines_of
from harness.conformance.vectors import VectorSet, generate
from harness.errors import MachineError
from harness.play.remote.agent_pool import PLACES, AgentPool
from harness.scenario.scenario_file import Document, to_yaml
from netem.capture import begin_file
from netem.frames import udp_broadcast
from netem.pcapng import PcapngFile
from ucp.messages import PORT, decode
from ucp.settings import Settings

COMMENT = (
    "Play it with `ucp-harness run FILE --backend sim`, if the agent supports virtual time.",
    "The verdict on every step shows where the agent deviates from Algorithms 1 to 20.",
)


def scenario_of(name: str, command: Sequence[str], variant: SettingsVariant, path: Sequence[str]) -> str:
    """Return the text of a scenario that gives these inputs to the agent. Raises NotPlayableError."""
    script: list[Document] = []
    datagrams: list[Document] = []
    timeline: list[Document] = [{"at_s": 0, "kill": list(PEERS)}]
    writer = LineWriter(variant)
    for line in writer.lines(path):
        match line.given:
            case {"t": at_s, "datagram": datagram}:
                source = decode(base64.b64decode(datagram)).sender
                datagrams.append({"source": source, "datagram": datagram, "reaches": {AGENT: at_s}})
            case {"t": at_s, "event_id": event_id, "data": data, "timestamp_us": timestamp_us}:
                event = {"event_id": event_id, "data": data, "timestamp_us": timestamp_us}
                script.append({"at_s": at_s, "agent": AGENT, **event})
            case {"t": at_s, "command": asked}:
                timeline.append({"at_s": at_s, asked: [AGENT]})
    document: Document = {
        "name": name,
        "agents": list(ROSTER),
        "agent_command": {AGENT: list(command)},
        "duration_s": math.ceil(writer.now) + 1,
        "initial_data": base64.b64encode(INITIAL_DATA).decode("ascii"),
        "settings": _non_default(variant.settings.to_json()),
        "timeline": timeline,
        "events": {"source": "scripted"} | ({"script": script} if script else {}),
        "datagrams": datagrams,
    }
    return to_yaml({key: value for key, value in document.items() if value not in ({}, [])}, COMMENT)


def _non_default(settings: dict[str, Any]) -> dict[str, object]:
    default = Settings().to_json()
    return {name: value for name, value in settings.items() if name not in default or default[name] != value}


EPOCH_US = 1_700_000_000_000_000
"""The time of mission second 0 in the capture, in microseconds since the Unix epoch."""


def keep(case: CaseResult, command: Sequence[str], directory: Path) -> None:
    """Write the files of a failure into a new directory. Raises MachineError if the files cannot be written."""
    try:
        directory.mkdir(parents=True)
        lines = list(lines_of(case))
        if case.settings in VARIANTS:
            try:
                vector = _vector(case)
                scenario = scenario_of(case.name, command, VARIANTS[case.settings], case.inputs)
            except NotPlayableError as error:
                lines.append(f"  these inputs have no scenario, because {error} is impossible in virtual time")
            else:
                (directory / "vector.jsonl").write_text(vector, encoding="utf-8")
                (directory / "scenario.yaml").write_text(scenario, encoding="utf-8")
        (directory / "failure.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        if case.exchanges:
            _write_capture(case.exchanges, directory)
    except OSError as error:
        raise MachineError(f"{directory} cannot be written: {error.strerror}") from None


def _vector(case: CaseResult) -> str:
    writer = LineWriter(VARIANTS[case.settings])
    steps: list[dict[str, Any]] = [{"in": writer.first_line(), "out": {"sent": [], "timer": None}}]
    for line in writer.lines(case.inputs):
        steps.append({"in": line.given, "out": line.answer, "says": line.input_text, "sends": line.sent_texts})
    return "".join(json.dumps(step) + "\n" for step in steps)


def _write_capture(exchanges: Sequence[RecordedDatagram], directory: Path) -> None:
    path = directory / "air.pcapng"
    begin_file(directory, AGENTS_VEHICLE, EPOCH_US, 1.0).rename(path)
    capture = PcapngFile(path)
    for exchange in exchanges:
        at_ns = EPOCH_US * 1000 + round(exchange.t * 1e9)
        frame = udp_broadcast(AGENTS_VEHICLE if exchange.sent else PEERS_VEHICLE, PORT, exchange.data)
        capture.packet(at_ns, frame, outbound=exchange.sent)
    capture.close()


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
