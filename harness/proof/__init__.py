"""Prove properties of a small swarm: explore every state that its agents can reach. See docs/explanation/proof.md.

The agents in a state are real agents (`ucp.agent`), so a proof is about the real code. The module `bounds` defines the
size of the swarm and the behaviour of the network. The sub-packages:

- `model`: the successors of a state. Local states with equal behaviour are equal, which keeps the graph small.
- `graph`: all reachable states, breadth first, on all processor cores.
- `questions`: properties of the whole graph: livelocks, paths to one common chain, and the number of further votes.
- `attacker`: the messages that the holder of one vehicle's keys can send.
- `examples`: conversion of a path through the graph to a scenario that the simulation plays.
- `coverage`: the share of the reachable states that runs have reached.
- `specification`: the same exploration with a TLA+ specification, as a second opinion.
"""

from harness.proof._progress_bar import ExplorationProgress
from harness.proof._proof import Limits, Proof, prove
from harness.proof._proof_text import in_words
from harness.proof.bounds import Bounds, BoundsError, Network

__all__ = ["Bounds", "BoundsError", "ExplorationProgress", "Limits", "Network", "Proof", "in_words", "prove"]
