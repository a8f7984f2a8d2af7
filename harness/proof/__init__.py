"""Proof by exhaustion: all that the real agent can come to within bounds, and whether it may. See docs/proof.md.

bounds.py     within which everything is looked at
model/snapshot.py   an agent's whole state: copied, put back, as a key
model/flaws.py      what must never be at one agent
model/snapshot.py      the parts of states, each once
model/block_renaming.py     which blocks a state is about, and the same state about others
model/known_states.py      local states by number, and by which names they know the others
model/real_agents.py     the real agents, put into whatever state is looked at
model/snapshot.py       what an input makes of an agent
model/local_steps.py      each step from each local state, computed once, by the real agent
model/tallies.py    what tallies decide, so that the rest of them may be forgotten
model/reduction.py  what agents must not do where states that behave alike are one
model/reference_step.py  whether a step is that of a right agent
model/zones.py      how long timers have yet to run, compared with each other
model/instant.py    what an instant makes of the agents: who hears what in which order, and loses what
attacker/forgeries.py    all that a captor can say to an agent, up to what the agent can tell apart
attacker/attacker.py     what somebody who has a vehicle's keys can say in each state
attacker/security_gate.py       the real gate that it has to come through
model/any_sender.py      network any: each agent by itself, against all that could ever be sent
model/canonical_order.py      of all orders of the agents one that stands for all
model/global_states.py      global states, and all that may happen next
graph/expansion.py  what may follow one state
graph/expansion.py Python's collector rests meanwhile
graph/workers.py       other processes that look at states, too
graph/packed_states.py     what is kept of each state, in little room
graph/exploration.py    all of them, breadth first
questions/attractor.py  from which states a goal is come to, whichever timer is the next to end
questions/graph_cycles.py     ways that lead back to where they began
questions/extra_votes.py      how many more votes it takes until there is one chain
questions/convergence.py   whether there is always a way to rest with one chain, and whether one goes round for ever
questions/livelock.py   the forms of going round, each with a scenario and what it takes to get there
examples/path_times.py      mission seconds for a way through the graph
examples/path_times.py       which block has to be older than which on it
examples/path_script.py     a way through the graph as a scenario that the simulation plays
attacker/timeline_entries.py    what a captor says as an entry of that scenario's timeline
examples/example.py    a scenario, played and written
_proof.py      all of that together
_proof_text.py      what came out, for people
../../docs/generate/wrong_agents_proof.py  what tells each wrong agent from the right one
"""

from harness.proof._progress_bar import Progress
from harness.proof._proof import INCOMPLETE, Limits, Proof, prove
from harness.proof._proof_text import in_words
from harness.proof.bounds import Bounds, BoundsError, Network

__all__ = ["INCOMPLETE", "Bounds", "BoundsError", "Limits", "Network", "Progress", "Proof", "in_words", "prove"]
