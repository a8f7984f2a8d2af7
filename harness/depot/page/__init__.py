"""The page of a consolidated record: one file, which loads nothing and runs no script.

page.py      gathers it             page.html.j2, page.css   how it looks, with the parts of a run's report
where.py     a map    along_time.py   when    holdings.py   who holds what
"""

from harness.depot.page.page import draw

__all__ = ["draw"]
