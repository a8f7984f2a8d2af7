"""What the chains say: the log that a swarm brought home, as text, JSON, GeoJSON and KML.

`read` gathers the exports, `text` and `document` tell them chain by chain, `positions` makes tracks of the vehicles'
positions for maps. Whether the chains are right is the checker's to say.
"""

from harness.report.logbook.book import Logbook, read

__all__ = ["Logbook", "read"]
