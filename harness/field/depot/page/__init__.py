"""The page of a consolidated record: one file, which loads nothing and runs no script.

depot_page.py      gathers it             page.html.j2, page.css   how it looks, with the parts of a run's report
position_map.py     a map    time_chart.py   when    holdings.py   who holds what
"""

from harness.field.depot.page.depot_page import draw

__all__ = ["draw"]
