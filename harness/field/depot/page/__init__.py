"""The page of a consolidated record: one file, which loads nothing and runs no script.

_depot_page.py      gathers it             page.html.j2, page.css   how it looks, with the parts of a run's report
_position_map.py     a map    _time_chart.py   when    _holdings.py   who holds what
"""

from harness.field.depot.page._depot_page import draw

__all__ = ["draw"]
