"""Test cases that are written by hand, for behaviour that the generated tests do not cover.

Each case starts its own agents and simulates their peers (`_bench`). The modules of this package cover hostile
datagrams, blocks and votes, start and end of the program, the disk, records, and missions with keys.

`handwritten` runs the cases. Some cases run in parallel. Each failed case runs a second time, without other cases at
the same time.
"""

import asyncio
from dataclasses import replace

from harness.conformance._udp_lab import AgentEndedError, UdpLab
from harness.conformance.cases import (  # noqa: F401  (each module adds its cases to ALL)
    _datagram_cases,
    _disk_cases,
    _program_cases,
    _record_cases,
    _secured_cases,
)
from harness.conformance.cases._bench import (
    ALL_CASES,
    CannotJudgeError,
    CaseBench,
    HandwrittenCase,
    WrongBehaviourError,
)
from harness.conformance.results import CaseResult
from harness.errors import UnsupportedError
from harness.play.agent_control import AgentRefusedError, AgentUnsupportedError
from ucp.agent import HANDLERS

__all__ = ["ALL_CASES", "handwritten"]


PARALLEL_CASES = 4
RETRIES = 2
"""Number of repetitions in which a case must fail again to count as a failure."""

_HANDLER = {handler.algorithm: handler.name for handler in HANDLERS.values()}


async def handwritten(lab: UdpLab, only: str | None) -> list[CaseResult]:
    """Run all handwritten test cases, or those of one Algorithm, and return their results."""
    cases = [case for case in ALL_CASES if only is None or only in (str(case.algorithm), _HANDLER.get(case.algorithm))]
    results: dict[str, CaseResult] = {}
    waiting = iter(cases)

    async def work() -> None:
        for case in waiting:
            results[case.name] = await _play(lab, case)

    await asyncio.gather(*(work() for _ in range(PARALLEL_CASES)))
    for case in cases:
        for _ in range(RETRIES):
            if results[case.name].verdict == "failed":
                results[case.name] = await _play(lab, case)
    return [results[case.name] for case in cases]


async def _play(lab: UdpLab, case: HandwrittenCase) -> CaseResult:
    named = CaseResult(case.name, case.algorithm, "passed", _HANDLER.get(case.algorithm, ""), section=case.section)
    try:
        await case.play(CaseBench(lab))
    except (UnsupportedError, AgentUnsupportedError, CannotJudgeError) as error:
        return replace(named, verdict="not applicable", reason=str(error))
    except WrongBehaviourError as error:
        details = {
            "reason": str(error),
            "expected": (error.expected,),
            "received": (error.received,),
            "wrong": (str(error),),
        }
        return replace(named, verdict="failed", **details)  # type: ignore[arg-type]
    except (AgentEndedError, AgentRefusedError) as error:
        return replace(named, verdict="failed", reason=str(error), wrong=(str(error),))
    except (AssertionError, AttributeError, KeyError, LookupError, TypeError, ValueError, OSError) as error:
        reason = f"its answer is not usable: {type(error).__name__}: {error}"
        return replace(named, verdict="failed", reason=reason, wrong=(reason,))
    return named
