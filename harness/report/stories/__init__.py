"""Stories as text: what happens to agents, and below each sentence what they then do, to be read beside the thesis.

`text` reads and rewrites the files, `sentences` says what may happen in them, `telling` makes the answer of the agents'
traces, with names from `names`. Traces are what any agent writes, so a story is of any agent.
"""
