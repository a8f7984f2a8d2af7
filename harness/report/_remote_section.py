"""Describe the agents on other computers in the report: clocks, connections, and times in which they were cut off."""

from harness.archive.run_record import RunRecord
from harness.present import text
from harness.report import facts


def sentences(record: RunRecord) -> list[str]:
    """Return sentences about each agent on another computer. Return no sentences if all agents ran on this computer."""
    lines = []
    for agent_id, found in record.remote.items():
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


def _ms(seconds: float) -> str:
    return f"{text.value(round(1000 * seconds, 3))} ms"
