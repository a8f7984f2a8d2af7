"""Print the logbook of a swarm: all events in its chains, as text, JSON, GeoJSON and KML.

`book` reads the exports, `logbook_text` prints chain by chain, and `positions` and `map_files` make tracks for maps.
The checker judges whether the chains are correct.
"""

from harness.report.logbook.book import Logbook, read

__all__ = ["Logbook", "read"]
