"""report.html of a matrix: one file, which loads nothing and runs no script.

matrix_page.py       gathers it            page.html.j2, page.css   how it looks, with the parts of a run's report
heatmap.py    what can be shown     heatmap.py   of each cell     trend.py   over the nights
drilldown.py  the runs of a cell, and how to play them again
"""

from harness.sweep.matrix.report.matrix_page import to_html

__all__ = ["to_html"]
