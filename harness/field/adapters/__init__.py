"""Records of other implementations, brought into the house's formats: by an adapter that knows them.

adapter.py          what an adapter is, and what it yields
csv_adapter.py  CSV, one record in a row
rosbag_adapter.py, bags.py  ROS bags of version 1 and 2
adapter.py          a user's own adapter, by its name
written_records.py         reads sources, each by the adapter that knows it
written_records.py, written_records.py what comes of it: traces, exports, captures, and import.json
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
