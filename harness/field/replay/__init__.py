"""Replay the record of one agent step by step, forward or back, and compare each step with the reference core.

`_record_search` finds the record in a directory, `_agent_record` stores the lines of the record, and `_player` plays
the lines. The player saves its state at intervals, so that it can go back exactly. `breakpoints` defines places at
which the player stops: a line, a handler, a block or a difference. `_resumption` finds the place after a gap at which
the comparison can continue. `_other_agents` shows the steps of the other agents at the same time. `prompt` is the
interactive command line.
"""

from harness.field.replay._agent_record import RecordedTrace
from harness.field.replay._player import PERHAPS, RecordPlayer, ReplayResult
from harness.field.replay._record_search import open_record, open_records

__all__ = ["PERHAPS", "RecordPlayer", "RecordedTrace", "ReplayResult", "open_record", "open_records"]
