"""report.html of a matrix: one file, which loads nothing and runs no script.

_matrix_page.py       gathers it            page.html.j2, page.css   how it looks, with the parts of a run's report
_heatmap.py    what can be shown     _heatmap.py   of each cell     _trend.py   over the nights
_drilldown.py  the runs of a cell, and how to play them again
"""

from harness.sweep.matrix.report._matrix_page import to_html

__all__ = ["to_html"]
