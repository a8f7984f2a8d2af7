"""The questions of a proof: livelocks, ways to one chain, and the number of further votes."""
