"""The cases by hand: each with agents of its own, a few side by side; what fails is tried again, alone."""

import asyncio
from dataclasses import replace

from harness.conformance._udp_lab import AgentEndedError, Air
from harness.conformance.cases import ALL, Bench, ByHand
from harness.conformance.cases._bench import CannotTellError, WrongError
from harness.conformance.results import Case
from harness.errors import UnsupportedError
from harness.play.agent_control import AgentRefusedError, AgentUnsupportedError
from ucp.agent import HANDLERS

AT_ONCE = 4
TIMES = 2
"""A failure is one only if it comes again so often, alone."""

_HANDLER = {handler.algorithm: handler.name for handler in HANDLERS.values()}


async def by_hand(air: Air, only: str | None) -> list[Case]:
    """All cases, or those of one Algorithm."""
    cases = [case for case in ALL if only is None or only in (str(case.algorithm), _HANDLER.get(case.algorithm))]
    tried: dict[str, Case] = {}
    waiting = iter(cases)

    async def work() -> None:
        for case in waiting:
            tried[case.name] = await _play(air, case)

    await asyncio.gather(*(work() for _ in range(AT_ONCE)))
    for case in cases:
        for _ in range(TIMES):
            if tried[case.name].verdict == "failed":
                tried[case.name] = await _play(air, case)
    return [tried[case.name] for case in cases]


async def _play(air: Air, case: ByHand) -> Case:
    named = Case(case.name, case.algorithm, "passed", _HANDLER.get(case.algorithm, ""), section=case.section)
    try:
        await case.play(Bench(air))
    except (UnsupportedError, AgentUnsupportedError, CannotTellError) as error:
        return replace(named, verdict="not applicable", reason=str(error))
    except WrongError as error:
        said = {"reason": str(error), "expected": (error.expected,), "came": (error.came,), "wrong": (str(error),)}
        return replace(named, verdict="failed", **said)  # type: ignore[arg-type]
    except (AgentEndedError, AgentRefusedError) as error:
        return replace(named, verdict="failed", reason=str(error), wrong=(str(error),))
    except (AssertionError, AttributeError, KeyError, LookupError, TypeError, ValueError, OSError) as error:
        reason = f"its answer is not usable: {type(error).__name__}: {error}"
        return replace(named, verdict="failed", reason=reason, wrong=(reason,))
    return named
