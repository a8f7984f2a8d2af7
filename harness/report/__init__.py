"""The report: what a run directory holds, on one page that needs nothing else; in short as Markdown; as JUnit XML.

`remains` reads what there is, `page` gathers the pictures, `page.html.j2` lays them out, `markdown` and `junit` say the
same in fewer words, and `write` writes it all. Each picture has its own module and is made of plain values, no files.
"""

from harness.report.remains import Remains, read_remains
from harness.report.write import write, write_report

__all__ = ["Remains", "read_remains", "write", "write_report"]
