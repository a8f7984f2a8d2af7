"""How much of the protocol was tried: what runs reached, of what exists within bounds. See docs/coverage.md.

reached.py   what agents came to in runs: local states, with inputs, and branches
_share.py  what there is within bounds, by `harness.proof`
_share.py     the one of the other: as JSON, and in words
reached.py a run in virtual time that is watched while it is judged
"""

from harness.proof.coverage._share import Existing, Share, existing, in_words, to_json
from harness.proof.coverage.reached import Reached, Watcher, reached_in

__all__ = ["Existing", "Reached", "Share", "Watcher", "existing", "in_words", "reached_in", "to_json"]
