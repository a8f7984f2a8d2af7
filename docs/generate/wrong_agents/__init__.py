"""Wrong agents at play: what finds each quirk, how often, how soon, and whether it names the handler that is wrong.

wrong_trial.py          one run of a wrong swarm: which judgements are bad, since when, which handler is named
trials_page.py           ../../wrong-agents.md: a row for each quirk, from many runs
busy.yaml         a mission in which everything happens
at_the_desk.py    ../../wrong-agents-field.md: as processes, only their records brought home, what `replay` names
desk.yaml         its mission
"""
