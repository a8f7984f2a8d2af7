"""The questions of a proof: livelocks, paths to one chain, and the number of further votes."""
