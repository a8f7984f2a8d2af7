"""Test one agent alone, while the harness plays all other agents. See docs/how-to/test-one-agent.md.

The reference (`_reference_model`) is the independent transcription of Algorithms 1 to 20. `_alphabet` lists the inputs
that are possible in a state, and `_state_space` explores all states breadth first. A vector (`vectors`) is one state
with one input. It has the shortest path to the state, and the expected output. `_tours` leads one agent through many
vectors, and `_suite` runs many agents in parallel. A suspected failure is tried again, alone, before it counts.

An agent under test (`_agent_under_test`) is driven over UDP (`_udp_agent`) or in virtual time (`_virtual_agent`).
`_blame` names the handler that most likely caused a failure. `cases` holds handwritten tests of behaviour outside of
the state space, such as floods, reboots and wrong missions.
"""
