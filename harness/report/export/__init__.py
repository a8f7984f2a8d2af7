"""What a run left as files for the tools that people use: MCAP for Foxglove, Lichtblick and PlotJuggler, a
trace for Perfetto, a bag for ROS 2.

`Recording` opens the run, and `samples` are all that happened in it, in order of time; each format is one file that
writes them down.
"""

from harness.report.export._exported_run import Recording

__all__ = ["Recording"]
