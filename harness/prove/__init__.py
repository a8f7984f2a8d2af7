"""Proof by exhaustion: all that the real agent can come to within bounds, and whether it may. See docs/proof.md.

bounds.py     within which everything is looked at
snapshot.py   an agent's whole state: copied, put back, as a key
flaws.py      what must never be at one agent
parts.py      the parts of states, each once
blocks.py     which blocks a state is about, and the same state about others
known.py      local states by number, and by which names they know the others
agents.py     the real agents, put into whatever state is looked at
step.py       what an input makes of an agent
local.py      each step from each local state, computed once, by the real agent
tallies.py    what tallies decide, so that the rest of them may be forgotten
reduction.py  what agents must not do where states that behave alike are one
reference.py  whether a step is that of a right agent
zones.py      how long timers have yet to run, compared with each other
instant.py    what an instant makes of the agents: who hears what in which order, and loses what
letters.py    all that a captor can say to an agent, up to what the agent can tell apart
captor.py     what somebody who has a vehicle's keys can say in each state
gate.py       the real gate that it has to come through
alone.py      network any: each agent by itself, against all that could ever be sent
order.py      of all orders of the agents one that stands for all
swarm.py      global states, and all that may happen next
expansion.py  what may follow one state
collecting.py Python's collector rests meanwhile
crew.py       other processes that look at states, too
packed.py     what is kept of each state, in little room
explore.py    all of them, breadth first
attractor.py  from which states a goal is come to, whichever timer is the next to end
cycles.py     ways that lead back to where they began
votes.py      how many more votes it takes until there is one chain
liveness.py   whether there is always a way to rest with one chain, and whether one goes round for ever
livelock.py   the forms of going round, each with a scenario and what it takes to get there
times.py      mission seconds for a way through the graph
ages.py       which block has to be older than which on it
script.py     a way through the graph as a scenario that the simulation plays
wording.py    what a captor says as an entry of that scenario's timeline
example.py    a scenario, played and written
prove.py      all of that together
words.py      what came out, for people
wrong_agents.py  what tells each wrong agent from the right one
"""

from harness.prove.bounds import Bounds, BoundsError, Network
from harness.prove.progress import Progress
from harness.prove.prove import INCOMPLETE, Limits, Proof, prove
from harness.prove.words import in_words

__all__ = ["INCOMPLETE", "Bounds", "BoundsError", "Limits", "Network", "Progress", "Proof", "in_words", "prove"]
