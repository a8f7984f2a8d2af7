"""Explore scenarios for hours, guided by coverage, and continue every night. See docs/how-to/explore-every-night.md.

`_hunt` changes a kept scenario (`_mutation`), plays it (`_hunt_trial`) and keeps it if it reaches a new state, branch
or livelock. `_corpus` stores scenarios and findings in a directory. `_finding_identity` decides whether two runs show
the same finding. `_night` first plays known findings, then continues the hunt until the time is over, and writes a
page.
"""

from harness.sweep.explore.guided._night import NightResult, spend
from harness.sweep.explore.guided._night_text import in_words, watching

__all__ = ["NightResult", "in_words", "spend", "watching"]
