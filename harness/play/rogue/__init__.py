"""The rogue node: a sender outside the swarm that receives every datagram and sends messages in the names of agents.

`_rogue` decides what to send, and does no I/O. `_crafted` makes messages that no agent has sent, and `_captured_bundle`
seals them with the keys of a captured vehicle. Two drivers exist: the process `__main__` in a lab, and
`harness.play.simulation._simulated_rogue` in virtual time. `_journal` records each datagram.
`harness.checker.injections` finds in the traces how the agents handled them.
"""
