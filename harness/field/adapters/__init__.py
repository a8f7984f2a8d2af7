"""Convert records of other programs to the formats of the harness.

An adapter reads a source and yields observations: lines of traces, exports, datagrams and logged events. CSV files and
ROS bags have adapters here, and a user can name an adapter of their own. `imported_records` writes the observations as
traces, exports and captures, with `import.json` in the same directory.
"""

from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable
from harness.field.adapters.imported_records import import_records

__all__ = [
    "Adapter",
    "ChainExport",
    "Datagram",
    "LoggedEvent",
    "Observation",
    "TraceLine",
    "Unusable",
    "import_records",
]
