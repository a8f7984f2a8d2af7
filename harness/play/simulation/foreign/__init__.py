"""Agents that are not ours in virtual time: programs that are given lines and answer with lines.

_virtual_program.py   one of them as a process: what it is told, what it says, and for how long one waits
_virtual_program.py  those that wait for their next mission
_answer.py    what a line of theirs says
failure.py   how one ends a mission
_foreigners.py  whose program plays whom
_foreign_agent.py     one life of such an agent, as the simulation drives it
_foreign_secured.py   the same with keys
determinism.py     whether it is the same twice
"""
