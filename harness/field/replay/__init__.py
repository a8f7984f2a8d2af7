"""Replay one agent's record: feed it to the reference core step by step, forward and back.

`_record_search` finds the record in a directory, `_agent_record` holds its lines, and `_player` plays them. The
player copies its state before a step, so it can go back exactly. `breakpoints` stop it at a line, a handler, a block or
a difference. `_resumption` finds the place where an agent can be followed again after a gap. `_other_agents` shows what
the other agents did at the same moment. `prompt` is the interactive command line.
"""

from harness.field.replay._agent_record import Record
from harness.field.replay._player import Found, Player
from harness.field.replay._record_search import open_record, open_records

__all__ = ["Found", "Player", "Record", "open_record", "open_records"]
