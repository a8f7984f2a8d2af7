"""Import records of other implementations, so that the harness reads them as its own.

An adapter reads a source and yields observations: lines of traces, exports, datagrams, logged events. CSV files and ROS
bags have adapters here, and a user can name an adapter of their own. `written_records` writes the observations as
traces, exports and captures, with `import.json` beside them.
"""

from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable
from harness.field.adapters.written_records import bring_in

__all__ = [
    "Adapter",
    "ChainExport",
    "Datagram",
    "LoggedEvent",
    "Observation",
    "TraceLine",
    "Unusable",
    "bring_in",
]
