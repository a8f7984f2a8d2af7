"""An agent's record, fed into the reference core step by step, forward and back.

record.py     what one agent's trace has to be played: its lines in order, and what lies beside it
opening.py    finds records in what a user names
player.py     plays them, and goes back exactly
blocks.py     blocks by hash, wherever any record has them
exchanges.py  the messages between the agent and another, as both records have them
clock_set.py  whether the agent's clock was set while a timer ran
resumption.py where an agent that was lost can be followed again
places.py     places to stop at: a line, a handler, a block
names.py      what blocks are called, from whatever record says it
source.py     where a handler's code is
summary.py    what came of a whole record, for people
document.py   the same for programs
shown.py      words for a terminal, whatever a record has for words
words.py      a step, a state and a difference, for people
others.py     what the other agents did at that moment
prompt.py     the commands of whoever steps through it
"""

from harness.field.replay.opening import open_record, open_records
from harness.field.replay.player import Player
from harness.field.replay.record import Record

__all__ = ["Player", "Record", "open_record", "open_records"]
