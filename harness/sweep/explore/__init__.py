"""Looking for a run that violates a characteristic, and for the smallest one that still does.

_exploring.py    seed after seed, until a run violates one
tape.py      what happened in a run by chance, taken down: events, and messages that were lost
_scenario_document.py  a scenario as a document that can be cut to pieces
_shrink.py    tries smaller documents, by delta debugging, on all cores
_smaller.py   what smaller means: fewer agents, events and fates, less time, less chance
_shrink.py     the smallest one as a scenario file, for people
_exploring.py       the story: all of these, one after the other
_explore_text.py     what is said meanwhile, and at the end
guided/      instead of seed after seed: scenarios changed, and kept where they reach something new
"""

from harness.sweep.explore._explore_text import in_words, watching
from harness.sweep.explore._exploring import MAX_RUNS, SEEDS, Explored, Violation, Watcher, explore

__all__ = ["MAX_RUNS", "SEEDS", "Explored", "Violation", "Watcher", "explore", "in_words", "watching"]
