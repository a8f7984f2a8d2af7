"""What the page and report.md both say of a run: what was asked, how it ended, and its figures."""

from typing import Any

from harness.archive.exports import Exports
from harness.archive.result import mapping, number, roster_of
from harness.play.backends import in_virtual_time
from harness.present import words

FIGURES = {
    "blocks": "blocks completed",
    "mutual_chain": "blocks in the mutual chain",
    "distinct_chains": "distinct chains",
    "uniform_at_s": "mission seconds until the chains were one",
    "reconciles": "reconciles",
    "copies_min": "fewest copies of a block",
    "copies_mean": "copies of a block, mean",
    "messages": "messages sent",
    "bytes": "bytes sent",
    "mutual_chain_before_final_reconcile": "blocks in the mutual chain before the final reconcile",
    "distinct_chains_before_final_reconcile": "distinct chains before the final reconcile",
}


def title(result: dict[str, Any]) -> str:
    return words.value(mapping(result, "scenario").get("name") or "unnamed scenario")


def summary(result: dict[str, Any], exports: Exports) -> list[str]:
    scenario = mapping(result, "scenario")
    parts = [words.value(result["outcome"])] if result.get("outcome") else []
    agents = len({*roster_of(result), *exports.by_agent})
    parts.append("1 agent" if agents == 1 else f"{agents} agents")
    duration_s, speedup = number(scenario, "duration_s"), number(scenario, "speedup")
    loss, wall_s = number(scenario, "network", "loss"), number(result, "wall_s")
    if duration_s is not None:
        parts.append(f"{words.duration(duration_s)} mission")
    if loss is not None:
        parts.append(f"{words.percent(loss)} loss")
    if speedup is not None and not in_virtual_time(result.get("backend")):
        parts.append(f"speedup {words.value(speedup)}")
    parts += [
        f"{key} {words.value(result[key])}" for key in ("seed", "backend", "engine") if result.get(key) is not None
    ]
    if wall_s is not None:
        parts.append(f"{words.duration(wall_s)} wall time")
    if result.get("started_at"):
        parts.append(f"started {words.started(result['started_at'])}")
    return parts


def outcome(result: dict[str, Any]) -> tuple[str, str] | None:
    """What kept the run from completing and the details, if something did."""
    outcome = result.get("outcome")
    if outcome == "completed":
        return None
    detail = result.get("outcome_detail")
    if outcome in (None, "running"):
        return "This run has not recorded its end", words.value(detail or "It is still going on, or it was killed.")
    return f"This run did not complete: {words.value(outcome)}", words.value(detail or "")


def figures(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Labels and values."""
    known = mapping(result, "figures")
    return [(FIGURES.get(key, words.label(key)), words.value(figure)) for key, figure in known.items()]
