"""A second opinion: the specification in TLA+ (ucp/spec), and what TLC, its model checker, says. See docs/spec.md.

tlc.py      whether TLC is here; a module given to it, and what it says
states.py   a state of the specification, and one of the real agents, as the same tuple
opinion.py  the same bounds looked at twice: by `harness.prove` and by TLC
"""

from harness.specification.opinion import Opinion, second_opinion

__all__ = ["Opinion", "second_opinion"]
