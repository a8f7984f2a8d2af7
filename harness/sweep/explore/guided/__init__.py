"""Exploration that is guided by what runs reach, and that goes on from night to night. See docs/nightly.md.

_mutation.py    a scenario changed by chance into another
_hunt_trial.py     one run, with a liveness phase at its end: what it reached, and what it showed
_hunt_trial.py      when timers ended in it, and who voted in vain on which way: what comes near a livelock
_finding_identity.py  what a finding is, whichever run shows it
_hunt.py      changing, playing, keeping
_corpus.py    what is kept between nights, in a directory
_night.py     a night: known findings, the hunt, what is new made small
_night_page.py      the page of it
_night_text.py     what is said meanwhile, and at the end
"""

from harness.sweep.explore.guided._night import Night, spend
from harness.sweep.explore.guided._night_text import in_words, watching

__all__ = ["Night", "in_words", "spend", "watching"]
