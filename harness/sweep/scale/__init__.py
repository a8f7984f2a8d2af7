"""The scale: how a swarm's cost grows with its number of agents and the length of its mission, in the simulation.

model.py     what is asked              _metrics.py   what is measured of each run
_run.py       the runs themselves        _cell.py      all runs of one size, summed up
_growth.py    fits of power laws         record.py    scale.json
outputs.py   the files     table.py  the terminal    _picture.py  scale.svg   _page.py  report.html
../../../docs/generate/complexity.py  ../../../docs/complexity.md: the figures beside what they mean
"""

from harness.sweep.scale._run import Finished, run_scale
from harness.sweep.scale.model import Scale, read_request
from harness.sweep.scale.record import ScaleRecord

__all__ = ["Finished", "Scale", "ScaleRecord", "read_request", "run_scale"]
