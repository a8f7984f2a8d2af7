"""Run agents in any language in virtual time. Such agents are programs that read inputs and write answers as lines of
text.

`line_program` starts a program and exchanges lines with it, within a limit of wall time. `_program_pool` keeps started
programs for later missions. `_answer` parses an answer. `_foreign_agent` lets the simulation drive one incarnation as
it drives its own agents, and `_foreign_secured` does so with keys. `_foreign_swarm` chooses the program of each agent.
`determinism` gives every incarnation its inputs again in another process, and compares the answers.
"""
