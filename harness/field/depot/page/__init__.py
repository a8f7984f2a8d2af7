"""Write the page of a merged record: one HTML file that loads no other files and runs no script.

`_depot_page` lays it out. It shows a map of the events, a chart over time, and the blocks that each vehicle holds.
"""

from harness.field.depot.page._depot_page import draw

__all__ = ["draw"]
