"""Records of other implementations, brought into the house's formats: by an adapter that knows them.

adapter.py          what an adapter is, and what it yields
csv_adapter.py  CSV, one record in a row
rosbag_adapter.py, bags.py  ROS bags of version 1 and 2
adapter.py          a user's own adapter, by its name
_importing.py         reads sources, each by the adapter that knows it
written_records.py, written_records.py what comes of it: traces, exports, captures, and import.json
"""

from harness.field.adapters._importing import bring_in
from harness.field.adapters.adapter import Adapter, ChainExport, Datagram, LoggedEvent, Observation, TraceLine, Unusable

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
