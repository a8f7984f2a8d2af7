"""The page: gathers what a run directory holds, draws the pictures, and writes `report.html` and `chains.svg`.

The page loads nothing; its Content-Security-Policy allows its own style sheet and the script of its timeline, which
it can do without, and nothing else.
Whatever comes from agents and scenarios is text to the template, which escapes all of it.
"""

import base64
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from harness.errors import RunDirectoryError
from harness.exports import BEFORE_FINAL_RECONCILE, Export, Exports, export_paths, read_exports
from harness.naming import name_blocks
from harness.report import map_section, network, survival, swarm, timeline, verdicts, words
from harness.report.chain_tree_svg import STYLE as TREE_STYLE
from harness.report.chain_tree_svg import ChainTreePicture
from harness.report.colours import Ink
from harness.report.map_svg import STYLE as MAP_STYLE
from harness.report.result import mapping, number, read_result
from ucp.files import write_atomically

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
EVIDENCE_SHOWN = 3
LONG_TEXT = 240

_HERE = Path(__file__).parent
_PAGE_STYLE = (_HERE / "page.css").read_text(encoding="utf-8")


def write_report(run_dir: Path) -> Path:
    """Write `report.html` and `chains.svg` into the run directory; the path of the page.

    Raises RunDirectoryError if there is no run's result in the directory, or if the disk refuses the report. Exports
    that are missing or damaged are said on the page.
    """
    result = read_result(run_dir / "run.json")
    exports = read_exports(export_paths(run_dir))
    ink = swarm.agent_inks(result, exports.by_agent)
    _write(run_dir / "chains.svg", ChainTreePicture(exports.by_agent, ink).standalone())
    page = run_dir / "report.html"
    _write(page, _page(result, exports, ink, run_dir))
    return page


def _page(result: dict[str, Any], exports: Exports, ink: Mapping[int, Ink], run_dir: Path) -> str:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(value=words.value)
    style = TREE_STYLE + MAP_STYLE + timeline.STYLE + _PAGE_STYLE
    judged, outcome = verdicts.verdicts(result), _outcome(result)
    return environment.get_template("page.html.j2").render(
        style=Markup(style),  # noqa: S704 - ours, and escaped it would not be what the digest is of
        style_digest=_digest(style),
        script=Markup(timeline.SCRIPT),  # noqa: S704 - ours as well
        script_digest=_digest(timeline.SCRIPT),
        title=words.value(mapping(result, "scenario").get("name") or "unnamed scenario"),
        about=mapping(result, "scenario").get("about"),
        summary=_summary(result, exports),
        headline=verdicts.headline(judged, completed=outcome is None),
        outcome=outcome,
        missing=swarm.missing(result, exports),
        export_errors=[error.replace(f"{run_dir}{os.sep}", "") for error in exports.errors],
        verdicts=judged,
        figures=[
            (FIGURES.get(key, words.label(key)), words.value(figure))
            for key, figure in mapping(result, "figures").items()
        ],
        survival=survival.section(result, ink),
        pictures=_pictures(exports, ink, run_dir),
        blocks=swarm.block_rows(exports.by_agent, ink),
        timeline=timeline.section(result, run_dir, ink, name_blocks(exports.by_agent)),
        strip=network.strip(result),
        network=network.start(result),
        faults=network.faults(result),
        flight=map_section.section(run_dir, ink),
        agents=swarm.agents_table(result, exports.by_agent, ink),
        versions=mapping(result, "versions"),
        evidence_shown=EVIDENCE_SHOWN,
        long_text=LONG_TEXT,
    )


def _digest(text: str) -> str:
    """As a Content-Security-Policy names what it allows."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def _pictures(exports: Exports, ink: Mapping[int, Ink], run_dir: Path) -> list[dict[str, Any]]:
    """The chains at the end of the run, and how the mission had left them where a final reconcile changed them."""
    if not exports.by_agent:
        return []
    before = read_exports(export_paths(run_dir / BEFORE_FINAL_RECONCILE)).by_agent
    if not before:
        return [_picture("", exports.by_agent, ink, "chains")]
    changed = any(
        agent_id in exports.by_agent and export.top_chain_hash != exports.by_agent[agent_id].top_chain_hash
        for agent_id, export in before.items()
    )
    if not changed:
        return [_picture("As the mission left them; the final reconcile changed nothing", before, ink, "chains")]
    return [
        _picture("As the mission left them", before, ink, "before"),
        _picture("After the final reconcile", exports.by_agent, ink, "chains"),
    ]


def _picture(heading: str, exports: Mapping[int, Export], ink: Mapping[int, Ink], key: str) -> dict[str, Any]:
    tree = ChainTreePicture(exports, ink, key)
    return {
        "heading": heading,
        "key": key,
        "hidden": tree.hidden,
        "abridged": tree.draw("abridged"),
        "full": tree.draw("full") if tree.hidden else None,
    }


def _summary(result: dict[str, Any], exports: Exports) -> list[str]:
    scenario = mapping(result, "scenario")
    parts = [words.value(result["outcome"])] if result.get("outcome") else []
    agents = len({*swarm.roster(result), *exports.by_agent})
    parts.append("1 agent" if agents == 1 else f"{agents} agents")
    duration_s, speedup = number(scenario, "duration_s"), number(scenario, "speedup")
    loss, wall_s = number(scenario, "network", "loss"), number(result, "wall_s")
    if duration_s is not None:
        parts.append(f"{words.duration(duration_s)} mission")
    if loss is not None:
        parts.append(f"{words.percent(loss)} loss")
    if speedup is not None and result.get("backend") != "sim":
        parts.append(f"speedup {words.value(speedup)}")
    parts += [
        f"{key} {words.value(result[key])}" for key in ("seed", "backend", "engine") if result.get(key) is not None
    ]
    if wall_s is not None:
        parts.append(f"{words.duration(wall_s)} wall time")
    if result.get("started_at"):
        parts.append(f"started {words.started(result['started_at'])}")
    return parts


def _outcome(result: dict[str, Any]) -> tuple[str, str] | None:
    """What kept the run from completing and the details, if something did."""
    outcome = result.get("outcome")
    if outcome == "completed":
        return None
    detail = result.get("outcome_detail")
    if outcome in (None, "running"):
        return "This run has not recorded its end", words.value(detail or "It is still going on, or it was killed.")
    return f"This run did not complete: {words.value(outcome)}", words.value(detail or "")


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise RunDirectoryError(f"{path}: cannot be written: {error.strerror}") from None
