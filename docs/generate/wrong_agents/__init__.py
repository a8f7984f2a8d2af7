"""Measure which check detects which deliberate error of agents, how often and how soon, and whether it names the wrong
handler.

wrong_trial.py          one run of a wrong swarm: which judgements are bad, since when, which handler is named
trials_page.py    ../../appendix/wrong-agents.md: a row for each quirk, from many runs
busy.yaml         a mission in which everything happens
at_the_desk.py    ../../appendix/wrong-agents-field.md: the findings of `replay` in the records of wrong agents
desk.yaml         its mission
"""
