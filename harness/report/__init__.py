"""The report: what a run directory holds, on one page that needs nothing else; in short as Markdown; as JUnit XML.

`source` is what it is made of, `page` gathers the pictures, `page.html.j2` lays them out, `markdown` and `junit` say
the same in fewer words, and `write` writes it all. Each picture has its own module and is made of plain values, no
files.
"""

from harness.report._report_source import ReportSource, read_source
from harness.report._run_page import write, write_report

__all__ = ["ReportSource", "read_source", "write", "write_report"]
