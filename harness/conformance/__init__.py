"""Test one agent alone, while the harness simulates all other agents. See docs/how-to/test-one-agent.md.

The reference (`_reference_model`) is the independent transcription of Algorithms 1 to 20. `_alphabet` lists the inputs
that are possible in a state, and `_state_space` explores all states breadth first. A vector (`vectors`) is a test case:
one state with one input. It contains the shortest sequence of inputs to the state, and the expected output. A tour
(`_tours`) tests one agent with many vectors in sequence, and `_suite` runs many agents in parallel. A suspected failure
counts only if it occurs again when the vector is repeated.

An agent under test (`_agent_under_test`) is driven over UDP (`_udp_agent`) or in virtual time (`_virtual_agent`).
`_blame` names the handler that most likely caused a failure. `cases` holds handwritten tests of behaviour outside of
the state space, such as floods, reboots and wrong missions.
"""
