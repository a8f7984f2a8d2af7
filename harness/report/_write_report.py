"""Writing the report: page, chain tree, Markdown and JUnit XML."""

from pathlib import Path

from harness.archive.archive import RunArchive
from harness.errors import RunDirectoryError
from harness.gc_pause import gc_paused
from harness.report._report_source import ReportSource, read_source
from harness.report._run_page import draw
from harness.report._run_summary import to_junit, to_markdown
from harness.report.chain_tree_svg import ChainTreePicture
from ucp.agent_files import write_atomically


@gc_paused()
def write_report(archive: RunArchive) -> Path:
    """Write `report.html`, `chains.svg`, `report.md` and `junit.xml` into the run directory; the path of the page.

    Raises RunDirectoryError if there is nothing of a run in the directory, or if the disk refuses the report. What is
    missing or damaged is said on the page.
    """
    return write(read_source(archive))


def write(left: ReportSource) -> Path:
    """As `write_report` does, of what was read."""
    _write(left.run_dir / "chains.svg", ChainTreePicture(left.exports.by_agent, left.ink).standalone())
    _write(left.run_dir / "report.md", to_markdown(left))
    _write(left.run_dir / "junit.xml", to_junit(left.record, _chains(left)))
    page = left.run_dir / "report.html"
    _write(page, draw(left))
    return page


def _chains(left: ReportSource) -> dict[int, tuple[str, ...]]:
    return {agent_id: export.chain_of_block_hashes for agent_id, export in left.exports.by_agent.items()}


def _write(path: Path, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise RunDirectoryError(f"{path}: cannot be written: {error.strerror}") from None
