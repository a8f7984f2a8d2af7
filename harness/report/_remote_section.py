"""Describe agents that ran on other computers: their clocks, their connections, and the times when they were cut off
from the swarm.
"""

from collections.abc import Iterator

from harness.archive.run_record import RemoteRecord, RunRecord
from harness.present import text
from harness.report import facts


def sentences(record: RunRecord) -> list[str]:
    """Return sentences about each agent on another computer. Return no sentences if all agents ran on this computer."""
    lines = [*_workers(record)]
    for agent_id, found in record.remote.items():
        if found.worker is not None:
            continue
        where = f"Agent {agent_id} ran on the computer {found.host}"
        if found.offset_s is None or found.uncertainty_s is None or found.delay_s is None:
            lines.append(f"{where}. Its clock was not measured.")
            continue
        slow = "" if found.delay_p95_s is None else f", and in one of twenty times {_ms(found.delay_p95_s)} or more"
        lines.append(
            f"{where}. Its clock was {_ms(abs(found.offset_s))} {'ahead' if found.offset_s >= 0 else 'behind'}, within "
            f"{_ms(found.uncertainty_s)}. Its connection took {_ms(found.delay_s)} of wall time in one direction{slow}."
            " A delay that the scenario asks for contains this time. A link without such a delay has it in addition."
        )
    return lines + [f"{sentence[0].upper()}{sentence[1:]}." for sentence in facts.cut_off(record)]


def _workers(record: RunRecord) -> Iterator[str]:
    """Yield a sentence about each worker (a computer of a cluster) that ran agents."""
    played: dict[str, dict[int, RemoteRecord]] = {}
    for agent_id, found in record.remote.items():
        if found.worker is not None:
            played.setdefault(found.worker, {})[int(agent_id)] = found
    for worker, agents in played.items():
        where = facts.agents_in_words(agents)
        where = f"{where[0].upper()}{where[1:]} ran on the worker {worker}"
        clocks = [(found.uncertainty_s, found.offset_s) for found in agents.values() if found.uncertainty_s is not None]
        delays = [found.delay_s for found in agents.values() if found.delay_s is not None]
        if not clocks or not delays:
            yield f"{where}. Its clock was not measured."
            continue
        uncertainty_s, offset_s = min(clocks)
        yield (
            f"{where}. Its clock was {_ms(abs(offset_s or 0.0))} {'ahead' if (offset_s or 0.0) >= 0 else 'behind'}, "
            f"within {_ms(uncertainty_s)}. The connections of its agents took {_ms(min(delays))} to {_ms(max(delays))} "
            "of wall time in one direction. A delay that the scenario asks for contains this time."
        )


def _ms(seconds: float) -> str:
    return f"{text.value(round(1000 * seconds, 3))} ms"
