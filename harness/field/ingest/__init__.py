"""Read all files of a flight, and find out the agent, the flight and the usable part of each file.

Field data is often broken. Lines are truncated, two flights are in one file, a file exists twice, and unrelated files
lie in the same directory. Ingesting uses everything usable, and reports everything that it leaves out.
"""

from harness.field.ingest._ingest import FileRemark, Flight, IngestResult, UnusedPart
from harness.field.ingest._sorting import ingest_files

__all__ = ["FileRemark", "Flight", "IngestResult", "UnusedPart", "ingest_files"]
