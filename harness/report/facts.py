"""Collect the facts that both report.html and report.md contain: settings, result, numeric results, and frames that
packet captures lack.
"""

import math
import shlex
from collections.abc import Iterable, Mapping
from itertools import pairwise

from harness.archive.connectivity import QUALITY_LIMITS
from harness.archive.exports import Exports
from harness.archive.run_record import CapturedFrames, RunRecord
from harness.play.backends import in_virtual_time
from harness.present import text
from harness.report.agent_programs import programs
from harness.report.chain_tree import ranges
from harness.scenario.agent_options import quirks_in_words
from harness.scenario.scenario_file import to_yaml
from sitl.vehicle import VehicleType

IN_UML = "User Mode Linux"

FIGURES = {
    "blocks": "blocks completed",
    "mutual_chain": "blocks in the mutual chain",
    "distinct_chains": "distinct chains",
    "uniform_at_s": "mission seconds until all chains were equal",
    "reconciles": "reconciles",
    "copies_min": "fewest copies of a block",
    "copies_mean": "copies of a block, mean",
    "messages": "messages sent",
    "bytes": "bytes sent",
    "collisions": "frames lost in collisions",
    "airtime_s": "seconds of airtime",
    "airtime_per_block_s": "seconds of airtime per block",
    "mutual_chain_before_final_reconcile": "blocks in the mutual chain before the final reconcile",
    "distinct_chains_before_final_reconcile": "distinct chains before the final reconcile",
}


def vehicle_types(record: RunRecord) -> dict[int, VehicleType]:
    """Return the type of each vehicle as the scenario defines it."""
    if record.scenario is None:
        return {}
    return {vehicle: record.scenario.vehicles.type_of(vehicle) for vehicle in record.scenario.roster}


def title(record: RunRecord) -> str:
    return record.scenario.name if record.scenario else "unnamed scenario"


def summary(record: RunRecord, exports: Exports) -> list[str]:
    """Return short phrases about the run: its result, the swarm, the main settings, and the place and time of
    the run.
    """
    scenario = record.scenario
    parts: list[str] = [] if record.outcome == "running" else [record.outcome]
    agents = len({*record.known_agents, *exports.by_agent})
    parts.append("1 agent" if agents == 1 else f"{agents} agents")
    if scenario is not None:
        parts.append(f"{text.duration(scenario.duration_s)} mission")
        if isinstance(scenario.network.loss, float):
            parts.append(f"{text.percent(scenario.network.loss)} loss")
        parts += quirks_in_words(scenario.quirks)
        if not in_virtual_time(record.backend):
            parts.append(f"speedup {text.value(scenario.speedup)}")
    played = {"seed": record.seed, "backend": record.backend, "engine": record.engine}
    # numbers to type again: no digit groups
    parts += [f"{key} {value}" for key, value in played.items() if value is not None]
    parts += [program.in_words for program in programs(record)]
    if record.wall_s is not None:
        parts.append(f"{text.duration(record.wall_s)} wall time")
    if record.started_at:
        parts.append(f"started {text.started(record.started_at)}")
    return parts


def outcome(record: RunRecord) -> tuple[str, str] | None:
    """Return a headline and details if the run was not completed. Return None if it was completed."""
    if record.outcome == "completed":
        return None
    detail = record.outcome_detail
    if record.outcome == "running":
        return "The end of this run is not recorded", detail or "The run is still active, or it was killed."
    if record.outcome == "not supported":
        return "This run has no verdict", detail or "An agent lacks a feature that the run needs."
    return f"This run did not complete: {record.outcome}", detail or ""


def figures(record: RunRecord) -> list[tuple[str, str]]:
    """Return the numeric results of the run as pairs of label and value."""
    return [(FIGURES.get(key, text.label(key)), text.value(figure)) for key, figure in record.figures.items()]


def cut_off(record: RunRecord) -> list[str]:
    """Return a sentence for each time when agents on other computers were cut off, because their connections were lost.
    Agents of the same worker share a sentence. Further sentences name the vehicle programs that were lost, and the
    traces that are incomplete for this reason.
    """
    lines = []
    for computer, agents in _by_computer(record).items():
        cuts = sorted(
            (cut.from_s, math.inf if cut.until_s is None else cut.until_s, agent)
            for agent in agents
            for cut in record.remote[str(agent)].cut_off
        )
        while cuts:
            from_s, until_s, agent = cuts.pop(0)
            together = [agent]
            while cuts and cuts[0][0] <= until_s:
                _, later_s, agent = cuts.pop(0)
                until_s, together = max(until_s, later_s), [*together, agent]
            end = "until the end" if until_s == math.inf else f"to {until_s:.0f} s"
            one = len(set(together)) == 1
            lines.append(
                f"{agents_in_words(together)} {'was' if one else 'were'} cut off from {from_s:.0f} s {end}, because "
                f"the connection to {'its' if one else 'their'} {computer} was lost"
            )
    lost: dict[str, list[int]] = {}
    for vehicle, found in record.vehicles.items():
        if isinstance(worker := found.get("lost_with"), str):
            lost.setdefault(worker, []).append(int(vehicle))
    for worker, vehicles in lost.items():
        one = len(vehicles) == 1
        named = agents_in_words(vehicles).replace("agent", "vehicle")
        lines.append(f"{named} {'was' if one else 'were'} lost with {'its' if one else 'their'} worker {worker}")
    lines += [
        f"the trace of agent {agent} is incomplete: {lack}"
        for agent, remote in record.remote.items()
        if (lack := remote.lack) is not None
    ]
    return lines


def agents_in_words(agent_ids: Iterable[int]) -> str:
    """Return "agent 3", or "agents 1-3 and 7"."""
    *others, last = ranges(sorted({*agent_ids}))
    if not others:
        return f"agent{'s' if not last.isdigit() else ''} {last}"
    return f"agents {', '.join(others)} and {last}"


def _by_computer(record: RunRecord) -> dict[str, list[int]]:
    """Return a phrase for each computer that ran remote agents, with the IDs of these agents."""
    found: dict[str, list[int]] = {}
    for agent, remote in record.remote.items():
        computer = f"computer {remote.host}" if remote.worker is None else f"worker {remote.worker}"
        found.setdefault(computer, []).append(int(agent))
    return found


def gaps(captured: Mapping[str, CapturedFrames]) -> str | None:
    """Return a sentence about frames that packet captures lack. Return None if no frames are missing."""
    lacking = sorted(int(vehicle) for vehicle, frames in captured.items() if frames.dropped)
    if not lacking:
        return None
    dropped = sum(frames.dropped for frames in captured.values())
    received = sum(frames.received for frames in captured.values())
    whose = f"vehicle{'s' if len(lacking) > 1 else ''} {', '.join(ranges(lacking))}"
    return f"the capture lacks {dropped} of {received} frames, of {whose}, because this machine was too slow"


def link_qualities() -> list[str]:
    """Return the texts that explain the link qualities in the legend, beginning with the best quality."""
    limits = map(text.percent, QUALITY_LIMITS)
    return ["link", *(f"link that loses {low} to {high}" for low, high in pairwise(limits))]


def command_again(record: RunRecord, scenario: str) -> str:
    """Return the command that repeats the run. `scenario` is the path of its scenario file.

    In virtual time, the command produces exports and traces that are equal to the last byte.
    """
    words = ["ucp-harness", "run", scenario, "--backend", str(record.backend), "--seed", str(record.seed)]
    words += ["--watch"] if record.all_delivered else []
    words += ["--kernel", "uml"] if IN_UML in record.versions.get("kernel", "") else []
    return shlex.join(words)


def scenario_text(record: RunRecord) -> str:
    """Return the recorded scenario as YAML without default values. Return an empty text if no scenario is recorded."""
    if record.scenario is None:
        return ""
    return to_yaml(record.scenario.model_dump(mode="json", exclude_defaults=True), [])
