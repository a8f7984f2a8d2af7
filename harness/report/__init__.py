"""Write the report of a run: one HTML page that loads no other files, a Markdown summary, and JUnit XML.

`_report_source` reads the run directory, `_run_page` lays out the page, and `_run_summary` writes the short forms. Each
picture has a module of its own, which draws plain values and reads no files.
"""

from harness.report._report_source import ReportSource, read_source
from harness.report._run_page import write, write_report

__all__ = ["ReportSource", "read_source", "write", "write_report"]
