"""An agent's record, fed into the reference core step by step, forward and back.

_agent_record.py     what one agent's trace has to be played: its lines in order, and what lies beside it
_record_search.py    finds records in what a user names
_player.py     plays them, and goes back exactly
replay_names.py     blocks by hash, wherever any record has them
_peer_messages.py  the messages between the agent and another, as both records have them
_resumption.py  whether the agent's clock was set while a timer ran
_resumption.py where an agent that was lost can be followed again
breakpoints.py     places to stop at: a line, a handler, a block
replay_names.py      what blocks are called, from whatever record says it
breakpoints.py     where a handler's code is
replay_document.py    what came of a whole record, for people
replay_document.py   the same for programs
../../present/text.py      words for a terminal, whatever a record has for words
_step_text.py      a step, a state and a difference, for people
_other_agents.py     what the other agents did at that moment
prompt.py     the commands of whoever steps through it
"""

from harness.field.replay._agent_record import Record
from harness.field.replay._player import Player
from harness.field.replay._record_search import open_record, open_records

__all__ = ["Player", "Record", "open_record", "open_records"]
