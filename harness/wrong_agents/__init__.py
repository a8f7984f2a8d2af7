"""Wrong agents at play: what finds each quirk, how often, how soon, and whether it names the handler that is wrong.

trial.py          one run of a wrong swarm: which judgements are bad, since when, which handler is named
page.py           WRONG_AGENTS.md: a row for each quirk, from many runs
busy.yaml         a mission in which everything happens
at_the_desk.py    AT_THE_DESK.md: as processes, only their records brought home, what `replay` names
desk.yaml         its mission
"""
