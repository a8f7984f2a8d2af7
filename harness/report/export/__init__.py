"""Export a run to other tools: an MCAP file for Foxglove, Lichtblick and PlotJuggler, a Perfetto trace, or a ROS 2 bag.

`ExportedRun` reads the run, and its `samples` are all recorded values in order of time. Each format has a module that
writes it.
"""

from harness.report.export._exported_run import ExportedRun

__all__ = ["ExportedRun"]
