"""The report: what a run directory holds, on one page that needs nothing else.

`page` gathers, `page.html.j2` lays out; each picture has its own module and is made of plain values, no files.
"""

from harness.report.page import write_report

__all__ = ["write_report"]
