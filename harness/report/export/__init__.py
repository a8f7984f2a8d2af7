"""Export a run to other tools: an MCAP file for Foxglove, Lichtblick and PlotJuggler, a Perfetto trace, or a ROS 2 bag.

`ExportedRun` opens the run, and its `samples` are all recorded events in time order. One module writes each format.
"""

from harness.report.export._exported_run import ExportedRun

__all__ = ["ExportedRun"]
