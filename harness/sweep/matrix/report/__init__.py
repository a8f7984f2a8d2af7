"""Write the report of a matrix: one HTML file that loads no other files and runs no script.

`_matrix_page` lays it out. The report shows a heatmap of a numeric result, its trend over the nights, and the runs of
each cell with a command that plays one of them again.
"""

from harness.sweep.matrix.report._matrix_page import to_html

__all__ = ["to_html"]
