"""Agents that are not ours in virtual time: programs that are given lines and answer with lines.

virtual_program.py   one of them as a process: what it is told, what it says, and for how long one waits
virtual_program.py  those that wait for their next mission
answer.py    what a line of theirs says
failure.py   how one ends a mission
foreigners.py  whose program plays whom
foreign_agent.py     one life of such an agent, as the simulation drives it
foreign_secured.py   the same with keys
determinism.py     whether it is the same twice
"""
