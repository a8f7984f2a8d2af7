"""Conformance: test one agent alone, while the harness plays its peers. See docs/how-to/test-one-agent.md.

The reference (`_reference_model`) is the harness's own agent. `_alphabet` lists the inputs that are possible in a
state, and `_state_space` walks all states breadth first. `vectors` are the pairs of a state and an input, each with
the shortest path there and the expected output. `_tours` leads one agent through many vectors, and `_suite` runs many
agents side by side. A suspected failure is tried again, alone, before it counts.

An agent is driven over UDP (`_udp_subject`) or in virtual time (`_virtual_subject`). `_blame` names the handler that
explains all failures. `cases` holds tests that no state explains, such as floods, reboots and wrong missions.
"""
