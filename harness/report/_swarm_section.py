"""Show the swarm in the report: a table of agents with their vehicles, and a table of blocks."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from harness.archive.archive import RunArchive
from harness.archive.exports import Export, name_blocks
from harness.archive.run_record import AgentRecord, RunRecord
from harness.present import text
from harness.present.colours import AgentColours, inks
from harness.report.agent_programs import programs
from harness.report.chain_tree import holders, ranges

IN_THE_RECORD_ONLY = {"binary_sha256", "parameters_file"}
"""Fields of a vehicle that are in run.json but not in the table."""
MAX_PARAMETERS = 10
"""Maximum number of vehicle parameters that one table cell shows."""


@dataclass(frozen=True, slots=True)
class BlockRow:
    name: str
    ink: AgentColours
    at: str
    block_hash: str
    held_by: str


def agent_inks(archive: RunArchive) -> dict[int, AgentColours]:
    exports = archive.exports.by_agent
    makers = {block.agent_id for export in exports.values() for block in export.blocks()}
    return inks({*archive.roster, *exports, *makers, *archive.traces})


def missing(archive: RunArchive) -> list[str]:
    """Return one sentence for each reason why agents have no usable chain export."""
    by_reason: dict[str, list[int]] = {}
    for agent_id in archive.roster:
        if agent_id not in archive.exports.by_agent:
            by_reason.setdefault(_fate(archive.record.agents.get(str(agent_id))), []).append(agent_id)
    return [
        f"{'agent' if len(ids) == 1 else 'agents'} {', '.join(ranges(ids))}{fate}" for fate, ids in by_reason.items()
    ]


def _fate(agent: AgentRecord | None) -> str:
    if agent is None:
        return ": no usable export"
    if agent.outcome == "killed":
        return ": killed, with all its blocks"
    why = ", ".join(filter(None, (agent.outcome, agent.detail)))
    return ": no usable export" + (f" ({why})" if why else "")


VEHICLE_FAULTS_KEY = "befallen"
"""Key of the list of faults in a vehicle's record."""


def agents_table(archive: RunArchive, ink: Mapping[int, AgentColours]) -> dict[str, object]:
    """Return the column titles, and one row for each agent with its vehicle. A row consists of the agent ID, a colour,
    and the cells by column title.
    """
    record, exports = archive.record, archive.exports.by_agent
    mixed = bool(programs(record))
    rows = []
    columns: dict[str, None] = {}
    for agent_id in sorted({*archive.roster, *exports}):
        agent = record.agents.get(str(agent_id))
        cells = _agent_cells(agent) if agent else {}
        if mixed and agent:
            cells |= {"program": shlex.join(agent.command or []) or None, "version": agent.version}
        if export := exports.get(agent_id):
            cells |= {
                "idle": export.idle,
                "completed": len(export.completed),
                "in chain": len(export.chain),
                "waiting": len(export.blocks_to_be_committed) + len(export.reconcile_stack),
            }
        for key, value in record.vehicles.get(str(agent_id), {}).items():
            if key == VEHICLE_FAULTS_KEY:
                cells[key] = _vehicle_faults(value)
                continue
            if key in IN_THE_RECORD_ONLY:
                continue
            if key == "parameters_given" and isinstance(value, dict):
                value = ", ".join(
                    f"{name} {text.value(parameter_value)}"
                    for name, parameter_value in list(value.items())[:MAX_PARAMETERS]
                )
            label = text.label(key)
            cells[f"vehicle {label}" if label in cells or key == "detail" else label] = value
        cells["detail"] = agent.detail if agent else None
        rows.append((agent_id, ink[agent_id], cells))
        columns |= dict.fromkeys(label for label, value in cells.items() if value is not None)
    return {"columns": sorted(columns, key=lambda label: label == "detail"), "rows": rows}


def _vehicle_faults(recorded: Any) -> str:
    """Describe the faults of a vehicle, such as "lose_gps at 40 s, wind at 80 s: not simulated"."""
    try:
        return ", ".join(
            f"{it['what']} at {it['at_s']:g} s{'' if it['parameters'] else ': not simulated'}" for it in recorded
        )
    except (KeyError, TypeError, ValueError):
        return text.value(recorded)


def _agent_cells(agent: AgentRecord) -> dict[str, object]:
    kept = agent.model_dump(mode="json", exclude={"detail", "dropped", "command", "version", "failures"})
    cells: dict[str, Any] = {text.label(key): value for key, value in kept.items()}
    cells["completed before"] = len(agent.completed_before) or None
    cells |= {"restarts": agent.restarts or None, "reboots": agent.reboots or None}
    runs = [life.counted for life in agent.handler_runs if life is not None]
    cells["handler runs"] = " + ".join(map(text.value, runs)) or None
    cells["failed"] = ", ".join(f"at {failure.at_s:g} s" for failure in agent.failures) or None
    if agent.dropped:
        cells["dropped"] = ", ".join(f"{text.value(count)} {reason}" for reason, count in agent.dropped.items())
    return cells


def counts(exports: Mapping[int, Export], record: RunRecord) -> str | None:
    """Return a sentence about completed blocks that are in no chain, and about blocks that agents hold although no
    record lists them as completed.

    Return None if the completed blocks are exactly the blocks in the chains.
    """
    completed = {block for export in exports.values() for block in export.completed}
    completed |= {block for agent in record.agents.values() for block in agent.completed_before}
    in_chains = {block.block_hash for export in exports.values() for block in export.chain}
    outside_chains = {block.block_hash for export in exports.values() for block in export.blocks()} - in_chains
    if completed == in_chains:
        return None
    parts = [f"of {len(completed)} completed blocks {_count_are(len(completed & in_chains))} in a chain"]
    if waiting := len(completed & outside_chains):
        parts.append(f"{_count_are(waiting)} only in a deque or on a reconcile stack")
    if gone := len(completed - in_chains - outside_chains):
        parts.append(f"{_count_are(gone)} in no available export")
    if strange := len((in_chains | outside_chains) - completed):
        parts.append(f"beside these {_count_are(strange)} held without a record of completion")
    return "; ".join(parts).capitalize() + "."


def _count_are(count: int) -> str:
    return f"{count} is" if count == 1 else f"{count} are"


def block_rows(exports: Mapping[int, Export], ink: Mapping[int, AgentColours]) -> list[BlockRow]:
    """Return a table row for each block that is in a chain. The oldest block is first."""
    names, held_by = name_blocks(exports), holders(exports)
    blocks = {block.block_hash: block for export in exports.values() for block in export.chain}
    return [
        BlockRow(
            names[block.block_hash],
            ink[block.agent_id],
            text.moment(block.timestamp_us),
            block.block_hash,
            ", ".join(ranges(held_by[block.block_hash])),
        )
        for block in sorted(blocks.values(), key=lambda block: (block.timestamp_us, block.block_hash))
    ]
