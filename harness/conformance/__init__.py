"""Conformance: one agent under test, whose peers the harness plays. Does it do what Algorithms 1-20 say?

_reference_model.py      the reference beside the agent: what must come of an input, and in which state that leaves it
_alphabet.py   the inputs that there are in a state: each message in the variants that matter, events, timers, commands
_state_space.py     states as far as they differ to an agent, and the walk over all of them, breadth first
vectors.py    the generated vectors; vectors.py writes them for others, as _virtual_lines.py spells them
_tours.py      one agent led through as many vectors as it takes, by the shortest ways
_suite.py      many tours side by side; what is suspected is tried again, alone
_subject.py    an agent under test; over UDP (_udp_subject.py, on the air of _udp_lab.py) or in virtual time
(_virtual_subject.py)
_observation.py       what is seen of it at one step, and whether that is right
_blame.py      which branch explains all failures
cases/        what no state explains, written by hand: malformed datagrams, floods, reboots, wrong missions;
_handwritten.py plays them
conformance_run.py        all of that together; results.py, results_table.py, conformance_page.py and _kept_failures.py
show and keep what came of it
"""
