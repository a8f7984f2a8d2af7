"""Conformance: one agent under test, whose peers the harness plays. Does it do what Algorithms 1-20 say?

model.py      the reference beside the agent: what must come of an input, and in which state that leaves it
alphabet.py   the inputs that there are in a state: each message in the variants that matter, events, timers, commands
states.py     states as far as they differ to an agent, and the walk over all of them, breadth first
vectors.py    the generated vectors; file.py writes them for others, as lines.py spells them
tours.py      one agent led through as many vectors as it takes, by the shortest ways
suite.py      many tours side by side; what is suspected is tried again, alone
subject.py    an agent under test; over UDP (over_udp.py, on the air of air.py) or in virtual time (virtual.py)
seen.py       what is seen of it at one step, and whether that is right
blame.py      which branch explains all failures
cases/        what no state explains, written by hand: malformed datagrams, floods, reboots, wrong missions; by_hand.py
              plays them
run.py        all of that together; results.py, table.py, page.py and keep.py show and keep what came of it
"""
