"""The files of a flight, as they came home: whose they are, of which flight, and what of them can be used.

Field data is broken: lines are cut, two flights are in one file, a file is there twice, others' files lie beside.
Everything usable is used, and whatever is left out is named.
"""

from harness.field.ingest._ingest import Flight, Homecoming, LeftOut, Remark
from harness.field.ingest._sorting import sort_out

__all__ = ["Flight", "Homecoming", "LeftOut", "Remark", "sort_out"]
