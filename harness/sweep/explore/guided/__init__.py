"""Exploration that is guided by what runs reach, and that goes on from night to night. See docs/nightly.md.

mutation.py    a scenario changed by chance into another
hunt_trial.py     one run, with a liveness phase at its end: what it reached, and what it showed
hunt_trial.py      when timers ended in it, and who voted in vain on which way: what comes near a livelock
finding_identity.py  what a finding is, whichever run shows it
hunt.py      changing, playing, keeping
corpus.py    what is kept between nights, in a directory
night.py     a night: known findings, the hunt, what is new made small
night_page.py      the page of it
night_text.py     what is said meanwhile, and at the end
"""

from harness.sweep.explore.guided.night import Night, spend
from harness.sweep.explore.guided.night_text import in_words, watching

__all__ = ["Night", "in_words", "spend", "watching"]
