"""The rogue node: it hears what is on the air, and sends what the timeline injects, in the names of agents.

`_rogue.py` decides what it sends, without I/O; `_crafted.py` makes the messages, `_crafted.py` seals them with
the keys of a vehicle that was captured. Two drivers: `__main__.py`, a process on the air of a lab, and
`harness.play.simulation._simulated_rogue`. `_journal.py` takes down what was sent; `harness.checker.injections` finds
in the traces what the agents did with it.
"""
