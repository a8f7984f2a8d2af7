"""The rogue node: it hears what is on the air, and sends what the timeline injects, in the names of agents.

`rogue.py` decides what it sends, without I/O; `crafted.py` makes the messages. Two drivers: `__main__.py`, a process on
the air of a lab, and `in_virtual_time.py`. `journal.py` takes down what was sent, `account.py` finds in the traces what
the agents did with it.
"""
