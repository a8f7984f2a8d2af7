"""Write the report of a run: one HTML page that loads no other files, a Markdown summary, and JUnit XML.

`_report_source` reads the run directory, this module lays out the page, and `_run_summary` writes the short forms. Each
picture has a module of its own, which draws plain values and reads no files.

The Content-Security-Policy of the page allows only its own style sheet and the script of its timeline. The page also
works without the script. The template escapes all text from agents and scenarios.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harness.archive.archive import RunArchive
from harness.archive.exports import Export, name_blocks
from harness.errors import RunDirectoryError
from harness.gc_pause import gc_paused
from harness.present.colours import AgentColours
from harness.report import _fault_sections, _map_section, _network_section, _swarm_section, facts, html, verdict_section
from harness.report import _timeline_section as timeline
from harness.report._report_source import ReportSource, read_source
from harness.report._run_summary import to_junit, to_markdown
from harness.report.chain_tree_svg import STYLE as TREE_STYLE
from harness.report.chain_tree_svg import ChainTreePicture
from harness.report.map_svg import STYLE as MAP_STYLE
from ucp.agent_files import write_atomically

__all__ = ["ReportSource", "read_source", "write", "write_report"]

EVIDENCE_SHOWN = 3
LONG_TEXT = 240
SCENARIO_FILE = "scenario.yaml"
MAX_SCENARIO = 100_000
"""Maximum number of characters of the scenario that the page shows. The run directory contains the complete
scenario.
"""

_TEMPLATE = Path(__file__).with_name("page.html.j2")


def draw(left: ReportSource) -> str:
    """Return the HTML page of a run."""
    record, exports, ink = left.record, left.exports, left.ink
    judged, outcome = verdict_section.verdicts(record), facts.outcome(record)
    timeline_section = timeline.section(left, name_blocks(exports.by_agent))
    scenario = facts.scenario_text(record)
    return html.render(
        _TEMPLATE,
        styles=[TREE_STYLE + MAP_STYLE + timeline.STYLE + html.PAGE_STYLE],
        script=timeline.SCRIPT if timeline_section else "",
        title=facts.title(record),
        about=record.scenario.about if record.scenario else "",
        summary=facts.summary(record, exports),
        headline=verdict_section.headline(judged, completed=outcome is None),
        outcome=outcome,
        missing=[
            ("Some chains are unknown. The page shows the other chains.", left.chains_missing),
            ("Some files of the run are missing. The page shows the other files.", left.files_missing),
            ("This run differs from its script.", record.unmatched_fates),
            ("This run differs from the expectations of its scenario.", left.unmet_expectations),
        ],
        verdicts=judged,
        figures=facts.figures(record),
        survival=_fault_sections.survival_section(record.survival, ink),
        pictures=_pictures(exports.by_agent, left.archive.before_final_reconcile, ink),
        counts=_swarm_section.counts(exports.by_agent, record),
        blocks=_swarm_section.block_rows(exports.by_agent, ink),
        timeline=timeline_section,
        strip=_network_section.strip(left.network, record.faults, timeline.end_s(left), record.channel),
        channel=_network_section.channel(record),
        remote=_fault_sections.remote_sentences(record),
        network=_network_section.initial_state(record.network),
        happened=_network_section.event_rows(record),
        ground_station=_network_section.ground_station(record),
        rogue=_fault_sections.rogue_section(record.rogue),
        flight=_map_section.section(left.archive.tracks(ink), left.network, ink, facts.vehicle_types(record)),
        agents=_swarm_section.agents_table(left.archive, ink),
        versions=record.versions,
        again=_again(left, scenario),
        scenario_file=SCENARIO_FILE,
        scenario=scenario if len(scenario) <= MAX_SCENARIO else "",
        evidence_shown=EVIDENCE_SHOWN,
        long_text=LONG_TEXT,
    )


def _again(left: ReportSource, scenario: str) -> str:
    """Return the command with which a user can repeat the run. Return an empty text if the run directory does not
    contain the scenario.
    """
    if not scenario:
        return ""
    given = SCENARIO_FILE if len(scenario) <= MAX_SCENARIO else str(left.run_dir)
    return facts.command_again(left.record, given)


def _pictures(
    exports: Mapping[int, Export], before: Mapping[int, Export], ink: Mapping[int, AgentColours]
) -> list[dict[str, Any]]:
    """Return two pictures of the chains: one shows them at the end of the mission, the other after the final reconcile.
    If the chains did not change between these times, return one picture.
    """
    if not exports:
        return []
    if not before:
        return [_picture("", exports, ink, "chains")]
    changed = any(
        agent_id in exports and export.top_chain_hash != exports[agent_id].top_chain_hash
        for agent_id, export in before.items()
    )
    if not changed:
        return [_picture("At the end of the mission; the final reconcile changed nothing", before, ink, "chains")]
    return [
        _picture("At the end of the mission", before, ink, "before"),
        _picture("After the final reconcile", exports, ink, "chains"),
    ]


def _picture(
    heading: str, exports: Mapping[int, Export], ink: Mapping[int, AgentColours], key: str
) -> dict[str, object]:
    tree = ChainTreePicture(exports, ink, key)
    return {
        "heading": heading,
        "key": key,
        "hidden": tree.hidden,
        "abridged": tree.draw("abridged"),
        "full": tree.draw("full") if tree.hidden else None,
    }


@gc_paused()
def write_report(archive: RunArchive) -> Path:
    """Write `report.html`, `chains.svg`, `report.md` and `junit.xml` into the run directory. Return the path of the
    page.

    The page lists missing and damaged files. Raises RunDirectoryError if the directory contains no run, or if the files
    cannot be written.
    """
    return write(read_source(archive))


def write(left: ReportSource) -> Path:
    """Write the report of a run whose files were already read. See `write_report`."""
    _write(left.run_dir / "chains.svg", ChainTreePicture(left.exports.by_agent, left.ink).standalone())
    _write(left.run_dir / "report.md", to_markdown(left))
    _write(left.run_dir / "junit.xml", to_junit(left.record, left.chains, left.top_chain_hashes))
    page = left.run_dir / "report.html"
    _write(page, draw(left))
    return page


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise RunDirectoryError(f"{path}: cannot be written: {error.strerror}") from None
