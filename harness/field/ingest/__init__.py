"""Read all files of a flight. Find out, for each file, its agent, its flight and the part that can be used.

Field data is often broken. Lines are truncated, two flights are in one file, a file exists twice, and unrelated files
lie in the same directory. This package uses every usable part, and reports every part that it omits.
"""

from harness.field.ingest._ingest import Flight, IngestResult, UnusedPart
from harness.field.ingest._sorting import ingest_files

__all__ = ["Flight", "IngestResult", "UnusedPart", "ingest_files"]
